"""Captures of other programs: files as each program writes them, of images that show one point as a white dot."""

import json
import re
import shutil

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from test_data_transforms import (
    FOCAL,
    HEIGHT,
    SIZE,
    TARGET,
    WIDTH,
    camera_to_world,
    check_dots,
    pinhole_place,
    save_dot,
    to_camera,
    write_frames,
    write_json,
    write_ply,
)

from a2tg_jax import load_scene
from a2tg_jax.data import decoding
from a2tg_jax.data.load import SceneSource

pytestmark = pytest.mark.filterwarnings("ignore:.*sparse points; starts from")
COUNT = 4
OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def poses():
    return [camera_to_world(index, COUNT) for index in range(COUNT)]


def save_dots(folder, names, place=lambda pose: pinhole_place(pose, **FOCAL)):
    for name, pose in zip(names, poses(), strict=True):
        save_dot(folder / name, place(pose))


def write_polycam(folder, prefix="corrected_"):
    """Raw data: a JSON file of the pose in ARKit's axes for each keyframe."""
    base = folder / "keyframes"
    save_dots(base / f"{prefix}images", [f"{index}.jpg" for index in range(COUNT)])
    (base / f"{prefix}cameras").mkdir()
    lens = dict(fx=100.0, fy=104.0, cx=58.0, cy=47.0, width=WIDTH, height=HEIGHT, blur_score=9.0)
    for index, pose in enumerate(poses()):
        numbers = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        (base / f"{prefix}cameras" / f"{index}.json").write_text(json.dumps({**lens, **numbers}))
    return base / f"{prefix}cameras"


@pytest.mark.parametrize("prefix", ["", "corrected_"])
def test_polycam(tmp_path, prefix):
    cameras = write_polycam(tmp_path, prefix)
    check_dots(load_scene(tmp_path), 0.1)
    values = json.loads((cameras / "1.json").read_text())
    (cameras / "1.json").write_text(json.dumps({key: str(value) for key, value in values.items()}))
    check_dots(load_scene(tmp_path), 0.1)
    (cameras / "1.json").write_text(json.dumps(values | {"fx": "wide"}))
    with pytest.raises(ValueError, match=r"1\.json: fx must be a number; got 'wide'"):
        load_scene(tmp_path)
    (cameras / "0.json").write_text("{}")
    with pytest.raises(ValueError, match=r"0\.json: lacks fx, a number of the camera"):
        load_scene(tmp_path)


def write_polycam_with_depth(folder):
    """The target's depth all over each map, in mm; the first map has low confidence."""
    keyframes = write_polycam(folder).parent
    for name in ("depth", "confidence"):
        (keyframes / name).mkdir()
    for index, pose in enumerate(poses()):
        depth = np.full((HEIGHT, WIDTH), round(1000 * to_camera(pose, TARGET)[2]), np.uint16)
        Image.fromarray(depth).save(keyframes / "depth" / f"{index}.png")
        confidence = np.full((HEIGHT, WIDTH), 255 * (index > 0), np.uint8)
        Image.fromarray(confidence).save(keyframes / "confidence" / f"{index}.png")


@pytest.mark.parametrize("has_size", [True, False])
def test_depth_maps_of_polycam_are_points(tmp_path, has_size):
    """Present exports have no width and height."""
    write_polycam_with_depth(tmp_path)
    for file in () if has_size else tmp_path.rglob("*.json"):
        values = json.loads(file.read_text())
        file.write_text(json.dumps({key: value for key, value in values.items() if key not in ("width", "height")}))
    scene = load_scene(tmp_path)
    check_dots(scene, 0.1)
    assert len(scene.points) == 3 * WIDTH * HEIGHT
    points = scene.transform.inverse().apply(scene.points)
    nearest = np.linalg.norm(points - TARGET, axis=1).argsort()[:3]
    assert np.linalg.norm(points[nearest] - TARGET, axis=1).max() < 0.03
    assert scene.colors[nearest].min() > 0.8 and scene.colors.mean() < 0.1


def test_the_black_border_of_corrected_images_is_masked(tmp_path):
    write_polycam(tmp_path)
    file = tmp_path / "keyframes" / "corrected_images" / "1.jpg"
    pixels = np.full((HEIGHT, WIDTH, 3), 200, np.uint8)
    pixels[:, :10] = 0
    pixels[40:50, 60:70] = 0
    Image.fromarray(pixels).save(file, quality=95)
    (view,) = [view for view in load_scene(tmp_path).train if view.name.endswith("1.jpg")]
    counts = view.mask.read()
    assert not counts[:, :11].any() and counts[:, 14:].all()


def write_record3d(folder, metadata="metadata", images="rgbd", **changes):
    """Poses are quaternions and positions, K is stored by columns, images are named by number."""
    save_dots(folder / images, [f"{index}.jpg" for index in range(COUNT)])
    rows = [[*Rotation.from_matrix(pose[:3, :3]).as_quat(), *pose[:3, 3]] for pose in poses()]
    values = dict(poses=rows, K=[100.0, 0, 0, 0, 104.0, 0, 58.0, 47.0, 1], **SIZE)
    (folder / metadata).write_text(json.dumps(values | changes))


@pytest.mark.parametrize(
    ("metadata", "images", "changes"),
    [
        ("metadata", "rgbd", {}),
        ("metadata.json", "rgb", dict(K=None, perFrameIntrinsicCoeffs=[[100.0, 104.0, 58.0, 47.0]] * COUNT)),
    ],
)
def test_record3d(tmp_path, metadata, images, changes):
    write_record3d(tmp_path, metadata, images, **changes)
    check_dots(load_scene(tmp_path), 0.1)
    save_dot(tmp_path / images / f"{COUNT}.jpg", (9, 9))
    with pytest.warns(UserWarning, match=rf"1 of {COUNT + 1} images have no pose, such as {COUNT}\.jpg: not used"):
        assert len(load_scene(tmp_path, test_every=0).train) == COUNT
    write_record3d(tmp_path, metadata, images, poses=[[0, 0, 0, 1, 0, 0]])
    with pytest.raises(ValueError, match="poses must be rows of 7 finite numbers"):
        load_scene(tmp_path)


def metashape_place(pose, f=100.0, b1=-4.0, cx=-2.0, cy=2.0, k1=-0.1, k2=0.02, k3=0.001, p1=0.004, p2=-0.003):
    """The place of the target by Metashape's manual: Brown's distortion, then f, b1 and the offset from the middle."""
    x, y, z = to_camera(pose, TARGET)
    x, y = x / z, y / z
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    moved_x = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
    moved_y = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    return WIDTH / 2 + cx + moved_x * (f + b1), HEIGHT / 2 + cy + moved_y * f


LENS = "<f>100</f><b1>-4</b1><cx>-2</cx><cy>2</cy><k1>-.1</k1><k2>.02</k2><k3>.001</k3><p1>.004</p1><p2>-.003</p2>"


def numbers(array):
    return " ".join(map(repr, np.asarray(array, float).ravel().tolist()))


def metashape_xml(world, within="component", lens=LENS):
    """cameras.xml whose chunk or component has the transform `world` (rotation, translation, scale)."""
    rotation, translation, scale = world
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * rotation, translation
    transform = f"""<transform><rotation locked="true">{numbers(rotation)}</rotation>
        <translation locked="true">{numbers(translation)}</translation><scale>{scale}</scale></transform>"""
    component = f'<component id="0">{transform if within == "component" else ""}</component>'
    cameras = ""
    for index, pose in enumerate(poses()):
        placed = pose @ OPENCV
        local = np.linalg.inv(matrix) @ placed
        local[:3, :3] *= scale
        cameras += f"""<camera id="{index}" sensor_id="0" component_id="0" label="C:\\shots\\{index}.png">
            <transform>{numbers(local)}</transform></camera>"""
    return f"""<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="Chunk 1">
        <sensors next_id="1"><sensor id="0" label="Phone" type="frame"><resolution width="{WIDTH}" height="{HEIGHT}"/>
        {'<calibration type="frame" class="initial"><f>50</f></calibration>' if lens else ""}
        <calibration type="frame" class="adjusted"><resolution width="{WIDTH}" height="{HEIGHT}"/>{lens}</calibration>
        </sensor></sensors><components>{component}</components>
        <cameras><group id="0" label="g">{cameras}</group></cameras>
        {transform if within == "chunk" else ""}</chunk></document>"""


WORLD = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix(), np.array([3.0, -2.0, 1.0]), 2.5


def write_metashape(folder, within="component"):
    save_dots(folder / "images", [f"{index}.png" for index in range(COUNT)], metashape_place)
    write_ply(folder / "points.ply")
    (folder / "cameras.xml").write_text(metashape_xml(WORLD, within))


@pytest.mark.parametrize("within", ["component", "chunk"])
def test_metashape(tmp_path, within):
    write_metashape(tmp_path, within)
    scene = load_scene(tmp_path)
    check_dots(scene, 0.1)
    np.testing.assert_allclose(scene.points[0], scene.transform.apply(TARGET), atol=1e-6)
    assert load_scene(tmp_path / "cameras.xml").name == tmp_path.name


def test_cameras_of_metashape_that_are_not_used(tmp_path):
    write_metashape(tmp_path)
    file = tmp_path / "cameras.xml"
    unaligned = '<camera id="9" sensor_id="0" label="9.png"/>'
    off = '<camera id="8" sensor_id="0" label="0.png" enabled="false"><transform>0</transform></camera>'
    file.write_text(file.read_text().replace("</cameras>", f"{unaligned}{off}</cameras>"))
    (tmp_path / "mesh.ply").touch()
    with pytest.warns(UserWarning) as printed:
        scene = load_scene(tmp_path)
    texts = " ".join(str(warning.message) for warning in printed)
    assert "2 of 6 cameras have no pose or are switched off, such as 9.png: not used" in texts
    assert "2 PLY files are beside it, mesh.ply, points.ply: none used" in texts
    assert len(scene.train) + len(scene.test) == COUNT


def rig_xml(in_rig, sensors=("",), master=0):
    """cameras.xml of two-camera rigs: each second camera has no pose but a master, and its sensor a place in the rig.

    Args:
      in_rig: [4, 4] from the second sensor's frame to the first one's.
      sensors: further elements of both sensors, or of the second.
      master: number of the camera of each rig that has the pose.
    """
    rotation = numbers(in_rig[:3, :3])
    translation = numbers(in_rig[:3, 3])
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    lens = f'<calibration type="frame" class="adjusted">{size}<f>100</f><b1>-4</b1></calibration>'
    place = f"<rotation>{rotation}</rotation><translation>{translation}</translation>"
    cameras = ""
    for index, pose in enumerate(poses()):
        placed = pose @ OPENCV @ (in_rig if master else np.eye(4))
        own = f"<transform>{numbers(placed)}</transform>"
        for number in range(2):
            tag = f'camera id="{2 * index + number}" sensor_id="{number}" label="{index}_{number}.png"'
            cameras += f"<{tag}>{own}</camera>" if number == master else f'<{tag} master_id="{2 * index + master}"/>'
    return f"""<document version="2.0.0"><chunk><sensors>
        <sensor id="0" type="frame">{size}{lens}</sensor>
        <sensor id="1" type="frame" master_id="0">{size}{lens}{"".join(sensors) or place}</sensor></sensors>
        <cameras>{cameras}</cameras></chunk></document>"""


@pytest.mark.parametrize("master", [0, 1])
def test_rigs_of_metashape(tmp_path, master):
    """The dot of every photograph is where the rig's own second camera sees it."""
    in_rig = np.eye(4)
    in_rig[:3, :3] = Rotation.from_rotvec([0.05, -0.1, 0.2]).as_matrix()
    in_rig[:3, 3] = 0.3, -0.1, 0.05
    lens = dict(fl_x=96.0, fl_y=100.0, cx=WIDTH / 2, cy=HEIGHT / 2)
    for index, pose in enumerate(poses()):
        save_dot(tmp_path / "images" / f"{index}_0.png", pinhole_place(pose, **lens))
        save_dot(tmp_path / "images" / f"{index}_1.png", pinhole_place(pose @ OPENCV @ in_rig @ OPENCV, **lens))
    (tmp_path / "cameras.xml").write_text(rig_xml(in_rig, master=master))
    printed = f"4 of 8 cameras have no own pose, such as 0_{1 - master}.png: placed by their sensors' offsets"
    with pytest.warns(UserWarning, match=printed):
        scene = load_scene(tmp_path)
    assert len(scene.train) + len(scene.test) == 8
    check_dots(scene, 0.05)


def test_rigs_of_metashape_without_offsets(tmp_path):
    save_dots(tmp_path / "images", [f"{index}_0.png" for index in range(COUNT)])
    (tmp_path / "cameras.xml").write_text(rig_xml(np.eye(4), sensors=(" ",)))
    with pytest.warns(
        UserWarning, match=r"4 of 8 cameras have no pose or are switched off, such as 0_1\.png: not used"
    ):
        assert len(load_scene(tmp_path, test_every=0).train) == COUNT


def fisheye_place(pose, projection, k=(0.0, 0.0, 0.0, 0.0), p1=0.0, p2=0.0):
    """The place of the target by Metashape's manual: the fisheye's radius of the angle, then Brown's distortion."""
    x, y, z = to_camera(pose, TARGET)
    angle = np.arctan2(np.hypot(x, y), z)
    radius = {"fisheye": angle, "equidistant_fisheye": angle, "equisolid_fisheye": 2 * np.sin(angle / 2)}[projection]
    x, y = np.array([x, y]) / np.hypot(x, y) * radius
    r2 = radius**2
    radial = 1 + sum(term * r2**power for power, term in enumerate(k, 1))
    moved_x = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
    moved_y = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    return WIDTH / 2 - 2 + moved_x * 96, HEIGHT / 2 + 2 + moved_y * 100


@pytest.mark.parametrize(
    ("projection", "terms"),
    [
        ("fisheye", dict(k=(0.05, -0.02, 0.01, 0.005), p1=0.004, p2=-0.003)),
        ("equidistant_fisheye", dict(k=(0.05, -0.02, 0.0, 0.0))),
        ("equisolid_fisheye", dict(k=(0.05, -0.02, 0.01, 0.005))),
    ],
)
def test_fisheyes_of_metashape(tmp_path, projection, terms):
    save_dots(
        tmp_path / "images", [f"{index}.png" for index in range(COUNT)],
        lambda pose: fisheye_place(pose, projection, **terms),
    )  # fmt: skip
    values = {f"k{power}": term for power, term in enumerate(terms["k"], 1)} | {"p1": 0.0, "p2": 0.0} | terms
    lens = "<f>100</f><b1>-4</b1><cx>-2</cx><cy>2</cy>" + "".join(
        f"<{name}>{values[name]}</{name}>" for name in ("k1", "k2", "k3", "k4", "p1", "p2")
    )
    xml = metashape_xml(WORLD, lens=lens).replace('type="frame"', f'type="{projection}"')
    (tmp_path / "cameras.xml").write_text(xml)
    check_dots(load_scene(tmp_path), 0.06)


@pytest.mark.parametrize(
    ("xml", "message"),
    [
        (metashape_xml(WORLD, lens="<f>100</f><k4>0.1</k4>"), r"\.png: its frame lens has k4, p3, p4 or b2"),
        (metashape_xml(WORLD, lens="<f>100</f><p4>0.1</p4>"), r"\.png: its frame lens has k4, p3, p4 or b2"),
        (metashape_xml(WORLD).replace('type="frame"', 'type="spherical"'), "of type spherical, .* views with a2tg sfm"),
        (
            metashape_xml(WORLD).replace('type="frame"', 'type="fisheye"').replace("</f>", "</f><p3>1</p3>"),
            "p3, p4 or b2",
        ),
        (
            metashape_xml(WORLD).replace('type="frame"', 'type="equisolid_fisheye"'),
            "its equisolid_fisheye lens has p1, p2",
        ),
        (metashape_xml(WORLD, lens=""), "is of a sensor without a calibration"),
        (metashape_xml(WORLD).replace("<f>100</f>", "<f>long</f>"), "1 numbers are expected; got long"),
        ('<!DOCTYPE x [<!ENTITY a "a">]><chunk><sensors/></chunk>', "it declares entities"),
        ("<chunk><sensors>", "cannot be read as XML"),
        ("<chunk><sensors/></chunk>", "none of its cameras has a pose and an image"),
    ],
)
def test_metashape_that_cannot_be_read(tmp_path, xml, message):
    save_dots(tmp_path / "images", [f"{index}.png" for index in range(COUNT)])
    (tmp_path / "cameras.xml").write_text(xml)
    with pytest.raises(ValueError, match=message):
        load_scene(tmp_path)


def test_xml_of_too_many_elements_or_with_entities_in_another_encoding_is_refused(tmp_path):
    """Elements take 50 times their bytes of memory; expat reads UTF-16, in which a search for ASCII finds nothing."""
    save_dots(tmp_path / "images", [f"{index}.png" for index in range(COUNT)])
    xmp = tmp_path / "images" / "0.xmp"
    entity = '<?xml version="1.0" encoding="utf-16"?><!DOCTYPE a [<!ENTITY e "long">]><a>&e;&e;</a><!--{}-->'
    # The letters of this comment have the bytes by which XMP files of RealityScan are recognised.
    xmp.write_bytes(entity.format(b"xcr:Rotation".decode("utf-16-le")).encode("utf-16"))
    with pytest.raises(ValueError, match=r"0\.xmp: cannot be read as XML \(it declares entities, or is UTF-16\)"):
        load_scene(tmp_path)
    xmp.write_bytes(b"<xcr:Rotation>" + b"<a>" * 500_000)
    with pytest.raises(ValueError, match=r"0\.xmp: cannot be read as XML \(it has 500,001 tags; the limit is 500,000"):
        load_scene(tmp_path)


@pytest.mark.parametrize("name", ["", "cameras.xml", "CAMERAS.XML", "images/Transforms.JSON"])
def test_a_scene_has_the_name_of_its_folder(tmp_path, name):
    assert SceneSource(str(tmp_path / "toy" / name)).name == ("toy/images" if "/" in name else "toy")


def realityscan_xmp(pose, position=(0, 0, 0), more='xcr:DistortionCoeficients="-0.1 0.02 0 0 0 0"'):
    """XMP as RealityCapture's page on its camera mathematics has it: lengths in units of the longer side."""
    rotation = (pose @ OPENCV)[:3, :3].T
    return f"""<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
        <rdf:Description xcr:Version="3" xcr:PosePrior="initial" xcr:DistortionModel="brown3"
        xcr:FocalLength35mm="{100 / WIDTH * 36}" xcr:Skew="0" xcr:AspectRatio="1.04" {more}
        xcr:PrincipalPointU="{-2 / WIDTH}" xcr:PrincipalPointV="{2 / WIDTH}"
        xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#"><xcr:Rotation>{numbers(rotation)}</xcr:Rotation>
        <xcr:Position>{numbers(pose[:3, 3] + position)}</xcr:Position></rdf:Description></rdf:RDF></x:xmpmeta>"""


def brown_place(pose):
    x, y, z = to_camera(pose, TARGET)
    r2 = (x / z) ** 2 + (y / z) ** 2
    radial = 1 - 0.1 * r2 + 0.02 * r2**2
    return 58 + 100 * radial * x / z, 47 + 104 * radial * y / z


def write_realityscan(folder, position=(0, 0, 0)):
    save_dots(folder, [f"{index}.png" for index in range(COUNT)], brown_place)
    for index, pose in enumerate(poses()):
        (folder / f"{index}.xmp").write_text(realityscan_xmp(pose, position))


def test_realityscan(tmp_path):
    write_realityscan(tmp_path)
    check_dots(load_scene(tmp_path), 0.1)
    shutil.copy(tmp_path / "0.png", tmp_path / "later.png")
    with pytest.warns(UserWarning, match="1 photograph without a pose, such as later.png: not used"):
        load_scene(tmp_path)
    (tmp_path / "later.png").unlink()
    (tmp_path / "0.xmp").write_text(realityscan_xmp(poses()[0], more='xcr:DistortionCoeficients="0 0 0 0 0.1 0"'))
    with pytest.raises(ValueError, match=r"0\.xmp: has the distortion model brown3 with skew, k4, t1 or t2"):
        load_scene(tmp_path)


@pytest.mark.parametrize("writer", [write_polycam, write_record3d, write_metashape, write_realityscan])
def test_cameras_without_an_image(tmp_path, writer):
    writer(tmp_path)
    images = sorted(tmp_path.rglob("*.[jp][pn]g"))
    images[0].unlink()
    with pytest.warns(UserWarning, match=r"1 of 4 cameras have no image beside them, such as .*0.*: not used"):
        scene = load_scene(tmp_path)
    assert len(scene.train) + len(scene.test) == 3
    for file in images[1:]:
        file.unlink()
    with pytest.raises(ValueError, match=r"none of its cameras has|no images rgb/0\.jpg|no photograph is beside"):
        load_scene(tmp_path)


def write_nerfstudio(folder):
    write_ply(folder / "points.ply")
    write_json(folder, write_frames(folder), ply_file_path="points.ply", **FOCAL)


def write_realityscan_in_images(folder):
    write_realityscan(folder)
    (folder / "images").mkdir()
    for file in [*folder.glob("*.*")]:
        file.rename(folder / "images" / file.name)


@pytest.mark.parametrize("writer", [write_nerfstudio, write_metashape, write_realityscan_in_images])
def test_photographs_that_are_too_large_are_read_smaller_as_the_error_says(tmp_path, monkeypatch, writer):
    """Their size is read from the large files where no other file has it."""
    writer(tmp_path)
    monkeypatch.setattr(decoding, "MAX_PIXELS", 6000)
    with pytest.raises(ValueError, match=r"is the limit; .* copies .* \(images_2, for a downscale of 2\)"):
        load_scene(tmp_path)
    (tmp_path / "images_2").mkdir()
    for file in (tmp_path / "images").glob("*.png"):
        Image.open(file).reduce(2).save(tmp_path / "images_2" / file.name)
    check_dots(load_scene(tmp_path, downscale=2), 0.2)


@pytest.mark.parametrize("writer", [write_metashape, write_realityscan])
def test_photographs_in_folders_below_images(tmp_path, writer):
    writer(tmp_path)
    for index in range(COUNT):
        folder = tmp_path / "images" / f"flight{index % 2}"
        folder.mkdir(parents=True, exist_ok=True)
        for file in (*tmp_path.glob(f"{index}.*"), *tmp_path.glob(f"images/{index}.*")):
            file.rename(folder / file.name)
    check_dots(load_scene(tmp_path), 0.1)


def test_points_of_another_coordinate_system_are_left_out(tmp_path):
    """Cameras in geocentric metres, points in degrees or near the origin, as Metashape exports them by default."""
    translation = WORLD[1]
    write_metashape(tmp_path)
    xml = metashape_xml(WORLD).replace(numbers(translation), numbers(translation + np.array([4e6, 0, 5e6])))
    (tmp_path / "cameras.xml").write_text(xml)
    with pytest.warns(UserWarning) as printed:
        scene = load_scene(tmp_path)
    texts = " ".join(str(warning.message) for warning in printed)
    assert "the points beside it are far from its cameras" in texts
    assert "starts from" in texts and np.abs(scene.points).max() < 100


def test_a_world_of_a_map_stays_there(tmp_path):
    """Its cameras are as near to each other as without the map, and its transform leads to the map."""
    offset = np.array([431_210.0, 5_412_000.0, 210.0])
    scenes = []
    for name, where in (("map", offset), ("near", np.zeros(3))):
        (tmp_path / name).mkdir()
        write_realityscan(tmp_path / name, where)
        scenes.append(load_scene(tmp_path / name))
    moved, near = scenes
    for view, other in zip(moved.train, near.train, strict=True):
        np.testing.assert_allclose(view.camera.viewmat, other.camera.viewmat, rtol=0, atol=1e-6)
    places = [scene.transform.inverse().apply(np.eye(3)) for scene in scenes]
    np.testing.assert_allclose(places[0], places[1] + offset, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("scan.psx", "Export Cameras"),
        ("scan.r3d", "unpack it"),
        ("IMG_0001.INSP", "equirectangular JPEG"),
        ("clip.osv", "equirectangular MP4"),
        ("poses_bounds.npy", "a2tg sfm"),
        ("opensfm/reconstruction.json", "export_colmap"),
        ("cameras.csv", "or XMP beside the photographs"),
        ("database.db", "colmap mapper"),
    ],
)
def test_a_capture_that_is_not_read(tmp_path, name, words):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).touch()
    for path in (tmp_path, tmp_path / name):
        with pytest.raises(FileNotFoundError, match=words):
            load_scene(path)
    for index in range(3):
        (tmp_path / f"{index}.jpg").touch()
    with pytest.raises(FileNotFoundError, match=rf"{words}.* or find cameras again: a2tg sfm .* SCENE|a2tg sfm finds"):
        load_scene(tmp_path)


def test_of_several_exports_of_metashape_the_usual_name_is_read(tmp_path):
    write_metashape(tmp_path)
    focals = {}
    for name in ("cameras (1).xml", "a.xml", "CAMERAS.XML"):
        (tmp_path / name).write_text(metashape_xml(WORLD, lens=f"<f>{100 + 10 * len(focals)}</f>"))
        focals[name] = 100 + 10 * len(focals)
    (tmp_path / "cameras.xml").rename(tmp_path / "old.xml")
    (tmp_path / "other.xml").write_text("<not-cameras/>")
    with pytest.warns(
        UserWarning, match=r"CAMERAS\.XML is read, and not a\.xml, cameras \(1\)\.xml, old\.xml; to read"
    ):
        scene = load_scene(tmp_path)
    assert scene.train[0].camera.K[0, 0] == focals["CAMERAS.XML"]
    assert load_scene(tmp_path / "a.xml").train[0].camera.K[0, 0] == focals["a.xml"]
    (tmp_path / "CAMERAS.XML").unlink()
    with pytest.warns(UserWarning, match=r"a\.xml is read, and not"):
        assert load_scene(tmp_path).train[0].camera.K[0, 0] == focals["a.xml"]


def write_record3d_twice(folder):
    write_record3d(folder)
    shutil.copy(folder / "metadata", folder / "metadata.json")


def write_polycam_twice(folder):
    write_polycam(folder)
    shutil.copytree(folder / "keyframes", folder, dirs_exist_ok=True)


def write_realityscan_twice(folder):
    write_realityscan(folder / "images")
    write_realityscan(folder)


def write_nerfstudio_twice(folder):
    write_nerfstudio(folder)
    shutil.copy(folder / "transforms.json", folder / "transforms (1).json")


def write_blender_twice(folder):
    write_nerfstudio(folder)
    shutil.copy(folder / "transforms.json", folder / "transforms_train.json")
    (folder / "transforms.json").rename(folder / "transforms_train (1).json")


@pytest.mark.parametrize(
    ("writer", "read", "other"),
    [
        (write_record3d_twice, "metadata", "metadata.json"),
        (write_polycam_twice, "corrected_cameras", "../corrected_cameras"),
        (write_realityscan_twice, "0.xmp", "images/0.xmp"),
        (write_nerfstudio_twice, "transforms.json", "transforms (1).json"),
        (write_blender_twice, "transforms_train.json", "transforms_train (1).json"),
    ],
)
def test_of_several_exports_one_is_read_with_a_warning(tmp_path, writer, read, other):
    writer(tmp_path)
    with pytest.warns(UserWarning, match=re.escape(f"{read} is read, and not {other}; to read another")):
        check_dots(load_scene(tmp_path), 0.1)


def test_a_copy_of_transforms_alone_is_named(tmp_path):
    write_nerfstudio(tmp_path)
    (tmp_path / "transforms.json").rename(tmp_path / "transforms (1).json")
    with pytest.raises(FileNotFoundError, match=r"has no transforms\.json, but transforms \(1\)\.json: give that file"):
        load_scene(tmp_path)
    check_dots(load_scene(tmp_path / "transforms (1).json"))


def test_transforms_come_first(tmp_path):
    """Polycam's folder after nerfstudio's conversion has both."""
    frames = write_frames(tmp_path)
    (tmp_path / "transforms.json").write_text(json.dumps({**FOCAL, **SIZE, "frames": frames}))
    (tmp_path / "cameras.xml").write_text("<sensors")
    (tmp_path / "images.psx").touch()
    check_dots(load_scene(tmp_path))
