"""A slow twin of the renderer: float64 numpy, one loop over the splats, no code shared with the package.

Each splat gives one `Layer` over the whole image; the layers are then composited front to back. There are no tiles and
no screen bounds: every splat is tried at every pixel. Letters: M takes (u, v, 1) to homogeneous pixels; k and l are the
planes through a pixel's column and row; p is their cross product; u, v are in standard deviations; H, W the image size.

Two images say where a comparison or a derivative is not to be trusted: `margin` is the smallest relative distance of a
decision from its threshold, beyond which values jump; `kink` the same where only the slope jumps.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

MIN_ALPHA = 1 / 255
MIN_TRANSMITTANCE = 1e-4


class Scene(NamedTuple):
    """Gaussians, textures, one camera and a background: everything an image depends on."""

    means: Float  # [N, 3]
    quats: Float  # [N, 4] wxyz
    log_scales: Float  # [N, 2]
    logit_opacities: Float  # [N]
    sh: Float  # [N, 16, 3]
    viewmat: Float  # [4, 4]
    K: Float  # [3, 3]
    width: int
    height: int
    textures: list[Float] | None  # N arrays [Tv, Tu, 4]
    background: Float  # [3]


class Rules(NamedTuple):
    """The named choices of the renderer."""

    sh_degree: int = 3
    near: float = 0.2
    uv: str = "texel-centre"
    outside: str = "clamp"
    rgb: str = "signed"
    alpha: str = "projected"
    max_alpha: float = 0.99
    extent: float = 3.0  # A texture covers this many standard deviations on each side of the mean.


OFFICIAL = Rules(uv="align-corners", outside="identity", rgb="unit", alpha="global-maximum", max_alpha=0.999)
"""The authors' program."""

DEFAULT_RULES = Rules()


class Hits(NamedTuple):
    """Where the rays of all pixels meet one splat."""

    u: Float  # [H, W], 0 without a hit
    v: Float  # [H, W], 0 without a hit
    depth: Float  # [H, W], the mean's where the low-pass filter decides
    rho: Float  # [H, W]
    rho_gradients: dict[str, Float]  # [H, W, 2 or 3] each: what each statistic multiplies by ∂L/∂ρ
    closest_rho: Float  # [H, W], as if every ray in front of or behind the camera could hit
    margin: Float  # [H, W]


class Shown(NamedTuple):
    """What one splat shows where the rays meet it."""

    strength: Float  # [H, W], alpha before the cut at 1/255 and the cap
    residual: Float  # [H, W, 3], added to its colour
    margin: Float | float  # [H, W]
    kink: Float | float  # [H, W]
    is_relevant: Bool  # [H, W]; elsewhere it is too weak on either side of a decision of where the ray meets it
    tint: Float | float = 1.0  # [H, W, 3], multiplies its colour before the residual is added


class Layer(NamedTuple):
    """One splat over the whole image, before compositing."""

    alpha: Float  # [H, W], 0 where skipped
    is_capped: Bool  # [H, W]
    color: Float  # [H, W, 3]
    depth: Float  # [H, W]
    mean_depth: float
    normal: Float  # [3]
    rho_gradients: dict[str, Float]  # as in Hits
    texel: Float | None  # [H, W, 4], what a lookup gave
    margin: Float  # [H, W]
    kink: Float  # [H, W]


class Image(NamedTuple):
    """A rendered view, the weight α·T of every splat at every pixel, and the distances from thresholds."""

    color: Float  # [H, W, 3]
    alpha: Float  # [H, W]
    depth: Float  # [H, W]
    normal: Float  # [H, W, 3]
    weights: Float  # [N, H, W]
    margin: Float  # [H, W]
    kink: Float  # [H, W]


def rotation_matrix(quat: Float) -> Float:
    """[3, 3] rotation of a quaternion wxyz of any length but 0."""
    w, x, y, z = quat / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def sh_basis(direction: Float) -> Float:
    """[16] real spherical harmonics of 3DGS, in its order and with its signs, at a unit vector: ±√(a/bπ)·polynomial."""
    x, y, z = direction
    xx = x * x
    yy = y * y
    zz = z * z
    polynomials = [
        (1, 4, 1),
        (-3, 4, y),
        (3, 4, z),
        (-3, 4, x),
        (15, 4, x * y),
        (-15, 4, y * z),
        (5, 16, 2 * zz - xx - yy),
        (-15, 4, x * z),
        (15, 16, xx - yy),
        (-35, 32, y * (3 * xx - yy)),
        (105, 4, x * y * z),
        (-21, 32, y * (4 * zz - xx - yy)),
        (7, 16, z * (2 * zz - 3 * xx - 3 * yy)),
        (-21, 32, x * (4 * zz - xx - yy)),
        (105, 16, z * (xx - yy)),
        (-35, 32, x * (xx - 3 * yy)),
    ]
    return np.array([np.sign(a) * np.sqrt(abs(a) / (b * np.pi)) * value for a, b, value in polynomials])


def lookup(texture: Float, u: Float, v: Float, rules: Rules) -> tuple[Float, Float, Float]:
    """Bilinear texel [H, W, 4] of a [Tv, Tu, 4] texture at (u, v), with its margin and kink."""
    rows, columns, _ = texture.shape
    (x, kink_x), (y, kink_y) = texel_position(u, columns, rules), texel_position(v, rows, rules)
    x0 = np.floor(x).astype(int)
    y0 = np.floor(y).astype(int)
    x1 = np.minimum(x0 + 1, columns - 1)
    y1 = np.minimum(y0 + 1, rows - 1)
    fx = (x - x0)[..., None]
    fy = (y - y0)[..., None]
    above = (1 - fx) * texture[y0, x0] + fx * texture[y0, x1]
    below = (1 - fx) * texture[y1, x0] + fx * texture[y1, x1]
    texel = (1 - fy) * above + fy * below
    if rules.outside == "clamp":
        return texel, np.full(u.shape, np.inf), np.minimum(kink_x, kink_y)
    largest = np.maximum(abs(u), abs(v))
    texel = np.where((largest > rules.extent)[..., None], [0.0, 0.0, 0.0, 1.0], texel)
    return texel, abs(largest / rules.extent - 1), np.minimum(kink_x, kink_y)


def shown_texture(scene: Scene, i: int, rules: Rules) -> Float:
    """[Tv, Tu, 4] residuals and alpha factors of splat `i` as they are seen."""
    if scene.textures is None:
        return np.array([[[0.0, 0.0, 0.0, 1.0]]])
    texture = scene.textures[i].copy()
    if rules.rgb == "unit":
        texture[..., :3] = np.clip(texture[..., :3], 0, 1)
    if rules.alpha == "global-maximum":
        largest = max(one[..., 3].max() for one in scene.textures)
        texture[..., 3] = np.clip(texture[..., 3] / (largest + 1e-6), 0, 1)
    return texture


def texel_position(u: Float, size: int, rules: Rules) -> tuple[Float, Float]:
    """Position in [0, size - 1] along one axis of a texture, and its distance in texels from a change of slope."""
    unit = (u / rules.extent + 1) / 2
    free = unit * (size - 1) if rules.uv == "align-corners" else unit * size - 0.5
    if size == 1:
        return np.zeros_like(u), np.full(u.shape, np.inf)
    return np.clip(free, 0, size - 1), abs(free - np.clip(np.round(free), 0, size - 1))


class Rays(NamedTuple):
    """The pixels' rays as planes, and where they cross the plane of one splat, in front of the camera or behind it."""

    k: Float  # [H, W, 3]
    l: Float  # noqa: E741  [H, W, 3]
    p: Float  # [H, W, 3]
    is_crossed: Bool  # [H, W]
    uv: Float  # [H, W, 2], arbitrary where not crossed
    xy: Float  # [H, W, 2] pixel centres
    offset: Float  # [H, W, 2] pixels from the projected mean


def cross_plane(M: Float, width: int, height: int) -> Rays:
    """Crosses the rays of all pixels with the plane of one splat."""
    xy = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    k = xy[..., :1] * M[2] - M[0]
    l = xy[..., 1:] * M[2] - M[1]  # noqa: E741
    p = np.cross(k, l)
    is_crossed = p[..., 2] != 0
    uv = p[..., :2] / np.where(is_crossed, p[..., 2], 1.0)[..., None]
    return Rays(k, l, p, is_crossed, uv, xy, xy - M[:2, 2] / M[2, 2])


def rho_gradients(rays: Rays, M: Float, position_jacobian: Float) -> tuple[Float, Float]:
    """[H, W, 3] each: ∂ρ₃/∂mean and ∂ρ₂/∂mean, with `position_jacobian` = ∂M[:, 2]/∂mean.

    Of k and l only the third entries depend on the mean, and p₂ does not contain them.
    """
    k, l, p, is_crossed, uv, xy, offset = rays  # noqa: E741
    dk = xy[..., :1] * position_jacobian[2] - position_jacobian[0]
    dl = xy[..., 1:] * position_jacobian[2] - position_jacobian[1]
    p2 = np.where(is_crossed, p[..., 2], 1.0)[..., None]
    du = (k[..., 1:2] * dl - l[..., 1:2] * dk) / p2
    dv = (l[..., 0:1] * dk - k[..., 0:1] * dl) / p2
    center = M[:2, 2] / M[2, 2]
    dcenter = (position_jacobian[:2] - center[:, None] * position_jacobian[2]) / M[2, 2]
    return 2 * uv[..., :1] * du + 2 * uv[..., 1:] * dv, -4 * offset @ dcenter


def intersect(
    M: Float, position_jacobian: Float, width: int, height: int, near: float, has_low_pass: bool = True
) -> Hits:
    """Meets the rays of all pixels with one splat; `position_jacobian` [3, 3] is ∂M[:, 2]/∂mean."""
    rays = cross_plane(M, width, height)
    hit_depth = rays.uv @ M[2, :2] + M[2, 2]
    is_hit = rays.is_crossed & (hit_depth >= near)
    rho2 = 2 * np.sum(rays.offset**2, axis=-1) if has_low_pass else np.full((height, width), np.inf)
    any_rho3 = np.where(rays.is_crossed, np.sum(rays.uv**2, axis=-1), np.inf)
    rho3 = np.where(is_hit, any_rho3, np.inf)
    is_low_pass = rho3 > rho2
    branch_of_low_pass = is_low_pass[..., None]
    gradient3, gradient2 = rho_gradients(rays, M, position_jacobian)
    # By the third column of M instead of the mean; M[2, 2] pixels of the projected mean are one of M[:2, 2].
    by_column3, _ = rho_gradients(rays, M, np.eye(3))

    k = rays.k
    l = rays.l  # noqa: E741
    summands = abs(k[..., 0] * l[..., 1]) + abs(k[..., 1] * l[..., 0])
    cancellation = abs(rays.p[..., 2]) / np.maximum(summands, np.finfo(float).tiny)
    with np.errstate(invalid="ignore"):
        branch = np.where(is_hit & has_low_pass, abs(rho3 - rho2) / (rho3 + rho2), np.inf)
    return Hits(
        u=np.where(is_hit, rays.uv[..., 0], 0.0),
        v=np.where(is_hit, rays.uv[..., 1], 0.0),
        depth=np.where(is_low_pass, M[2, 2], hit_depth),
        rho=np.where(is_low_pass, rho2, rho3),
        rho_gradients={
            "position": np.where(branch_of_low_pass, gradient2, gradient3),
            "screen": np.where(branch_of_low_pass, -4 * rays.offset, 0.0),
            "center": np.where(branch_of_low_pass, 0.0, by_column3[..., :2] * M[2, 2]),
        },
        closest_rho=np.minimum(any_rho3, rho2),
        margin=np.min([abs(hit_depth / near - 1), cancellation, branch], axis=0),
    )


def homography(scene: Scene, i: int) -> tuple[Float, Float]:
    """M [3, 3] of splat `i`, and ∂M[:, 2]/∂mean."""
    to_camera = scene.viewmat[:3, :3]
    translation = scene.viewmat[:3, 3]
    axes = to_camera @ rotation_matrix(scene.quats[i])[:, :2] * np.exp(scene.log_scales[i])
    mean = to_camera @ scene.means[i] + translation
    return scene.K @ np.column_stack([axes, mean]), scene.K @ to_camera


def view_direction(scene: Scene, i: int) -> Float:
    """Unit vector [3] in the world from the camera to the mean of splat `i`."""
    towards = scene.means[i] + scene.viewmat[:3, :3].T @ scene.viewmat[:3, 3]
    return towards / np.linalg.norm(towards)


def splat_layer(scene: Scene, i: int, rules: Rules, texel: Float | None = None) -> Layer:
    """Splat `i` at every pixel; `texel` [H, W, 4] replaces the lookup where given."""
    M, position_jacobian = homography(scene, i)
    hits = intersect(M, position_jacobian, scene.width, scene.height, rules.near)
    texture = shown_texture(scene, i, rules)
    found, margin, kink = lookup(texture, hits.u, hits.v, rules)
    texel = found if texel is None else texel
    opacity = 1 / (1 + np.exp(-scene.logit_opacities[i]))
    is_relevant = opacity * np.exp(-hits.closest_rho / 2) * max(texture[..., 3].max(), 1.0) >= 0.99 * MIN_ALPHA
    strength = opacity * np.exp(-hits.rho / 2) * texel[..., 3]
    layer = shown_layer(scene, i, rules, hits, Shown(strength, texel[..., :3], margin, kink, is_relevant))
    return layer._replace(texel=texel)


def shown_layer(scene: Scene, i: int, rules: Rules, hits: Hits, shown: Shown) -> Layer:
    """The layer of splat `i`, given where the rays meet it and what it shows there."""
    strength, (M, _) = shown.strength, homography(scene, i)
    is_visible = (strength >= MIN_ALPHA) & (M[2, 2] >= rules.near)
    direction = view_direction(scene, i)
    normal = rotation_matrix(scene.quats[i])[:, 2]
    facing = direction @ normal
    num_bases = (rules.sh_degree + 1) ** 2
    sh_color = sh_basis(direction)[:num_bases] @ scene.sh[i, :num_bases] + 0.5

    constants = np.broadcast_to([[[abs(facing)]], [[abs(M[2, 2] / rules.near - 1)]]], (2, *strength.shape))
    margins = np.broadcast_arrays(*constants, hits.margin, shown.margin, abs(strength / MIN_ALPHA - 1))
    margin = np.min(margins, axis=0) if M[2, 2] >= rules.near else constants[1]
    kink = np.minimum(np.minimum(abs(strength / rules.max_alpha - 1), shown.kink), abs(sh_color).min())
    return Layer(
        alpha=np.where(is_visible, np.minimum(strength, rules.max_alpha), 0.0),
        is_capped=strength > rules.max_alpha,
        color=np.maximum(sh_color, 0) * shown.tint + shown.residual,
        depth=hits.depth,
        mean_depth=float(M[2, 2]),
        normal=-normal if facing > 0 else normal,
        rho_gradients=hits.rho_gradients,
        texel=None,
        margin=np.where(shown.is_relevant, margin, np.inf),
        kink=np.where(is_visible, kink, np.inf),
    )


def splat_layers(scene: Scene, rules: Rules = DEFAULT_RULES, texels: list[Float] | None = None) -> list[Layer]:
    """The layers of all splats, by index; `texels` (N arrays [H, W, 4]) replace the lookups where given."""
    given = [None] * len(scene.means) if texels is None else texels
    return [splat_layer(scene, i, rules, texel) for i, texel in enumerate(given)]


def depth_order(layers: list[Layer]) -> list[int]:
    """Indices from front to back by the mean's depth, ties by index."""
    return sorted(range(len(layers)), key=lambda i: (layers[i].mean_depth, i))


def composite(layers: list[Layer], background: Float) -> Image:
    """Blends the layers front to back over the background."""
    shape = layers[0].alpha.shape
    transmittance = np.ones(shape)
    is_done = np.zeros(shape, bool)
    color = np.zeros((*shape, 3))
    depth = np.zeros(shape)
    normal = np.zeros((*shape, 3))
    weights = np.zeros((len(layers), *shape))
    margin = np.full(shape, np.inf)
    kink = np.full(shape, np.inf)
    last_depth = np.full(shape, -np.inf)
    for i in depth_order(layers):
        layer = layers[i]
        after = transmittance * (1 - layer.alpha)
        is_tried = ~is_done & (layer.alpha > 0)
        margin = np.where(is_done, margin, np.minimum(margin, layer.margin))
        margin = np.where(is_tried, np.minimum(margin, abs(after / MIN_TRANSMITTANCE - 1)), margin)
        # Equal depths come from equal means: a tie that the index breaks in every precision.
        gap = np.where(is_tried & (layer.mean_depth > last_depth), layer.mean_depth - last_depth, np.inf)
        margin = np.minimum(margin, gap / abs(layer.mean_depth))
        kink = np.where(is_done, kink, np.minimum(kink, layer.kink))

        is_done |= is_tried & (after < MIN_TRANSMITTANCE)
        is_shown = is_tried & ~is_done
        weights[i] = np.where(is_shown, layer.alpha * transmittance, 0.0)
        color += weights[i][..., None] * layer.color
        depth += weights[i] * layer.depth
        normal += weights[i][..., None] * layer.normal
        transmittance = np.where(is_shown, after, transmittance)
        last_depth = np.where(is_tried, layer.mean_depth, last_depth)
    color += transmittance[..., None] * background
    return Image(color, 1 - transmittance, depth, normal, weights, margin, kink)


def render(scene: Scene, rules: Rules = DEFAULT_RULES, texels: list[Float] | None = None) -> Image:
    """Renders a scene; `texels` (N arrays [H, W, 4]) replace the lookups where given."""
    return composite(splat_layers(scene, rules, texels), scene.background)


def gradient_statistic(
    scene: Scene, color_cotangent: Float, rules: Rules = DEFAULT_RULES, which: str = "position"
) -> Float:
    """[N, 3] sum over pixels of a derivative of g·color through the Gaussian factor exp(-ρ/2) alone.

    "position": |∂/∂mean| per component. "screen": |∂/∂c|, c the projected mean, where the low-pass filter decides, then
    0. "center": ∂/∂M[0, 2] and ∂/∂M[1, 2] times M[2, 2], where it does not, then 0.

    With α the blended opacity, T the transmittance before a splat and B all the light behind it,
    ∂(g·color)/∂α = g·(T·c - B/(1 - α)) and ∂α/∂ρ = -α/2; nothing flows where α is capped. `color_cotangent` is g,
    [H, W, 3].
    """
    layers = splat_layers(scene, rules)
    image = composite(layers, scene.background)
    behind = image.color.copy()
    statistic = np.zeros((len(layers), 3))
    for i in depth_order(layers):
        layer = layers[i]
        weight = image.weights[i][..., None]
        behind -= weight * layer.color
        is_shown = (image.weights[i] > 0) & ~layer.is_capped
        alpha = np.where(is_shown, layer.alpha, 0.5)[..., None]
        by_alpha = np.sum(color_cotangent * (weight * layer.color / alpha - behind / (1 - alpha)), axis=-1)
        by_rho = np.where(is_shown, -0.5 * layer.alpha * by_alpha, 0.0)
        moved = by_rho[..., None] * layer.rho_gradients[which]
        statistic[i, : moved.shape[-1]] = np.sum(moved if which == "center" else abs(moved), axis=(0, 1))
    return statistic
