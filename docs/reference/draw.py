"""Draws what `read_model` returns, slowly, as docs/formats.md says: one splat after the other, all pixels at once."""

import numpy as np

NEAR_PLANE, LEAST_ALPHA, LEAST_TRANSMITTANCE = 0.2, 1 / 255, 1e-4


def draw(
    model, viewmat, K, width, height, background=(0, 0, 0), max_alpha=0.99, uv="texel-centre", outside="clamp", extent=3
):
    """Return an image [height, width, 3] from a camera: world to camera [4, 4], and camera to pixels [3, 3].

    The texels are as shown: `rgb` "signed" and `alpha` "projected".
    """
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    axes = rotation @ rotations(model["quats"])[:, :, :2] * np.exp(model["log_scales"])[:, None]
    centers = model["means"] @ rotation.T + translation
    homographies = K @ np.concatenate([axes, centers[:, :, None]], axis=2)
    colors = own_colors(model["sh"], model["means"] + rotation.T @ translation)
    y, x = np.mgrid[:height, :width] + 0.5
    image, transmittance = np.zeros((height, width, 3)), np.ones((height, width, 1))
    starts = np.cumsum([0, *model["sizes"].prod(axis=1)]) if "sizes" in model else None
    is_live = np.ones((height, width, 1), bool)
    for i in np.argsort(centers[:, 2], kind="stable"):
        if centers[i, 2] < NEAR_PLANE:
            continue
        u, v, rho = intersected(homographies[i], x, y)
        texel = np.array([0.0, 0.0, 0.0, 1.0])
        if starts is not None and starts[i + 1] > starts[i]:
            texture = model["texels"][starts[i] : starts[i + 1]].reshape(*model["sizes"][i], 4)
            texel = looked_up(texture, u / extent, v / extent, uv)
            if outside == "identity":
                texel = np.where((np.maximum(abs(u), abs(v)) > extent)[..., None], [0.0, 0.0, 0.0, 1.0], texel)
        kernel = falloff(rho, model["exponents"][i] if "exponents" in model else 1.0)
        alpha = model["opacities"][i] * kernel[..., None] * texel[..., 3:]
        alpha = np.where(alpha < LEAST_ALPHA, 0, np.minimum(alpha, max_alpha))
        is_live &= transmittance * (1 - alpha) >= LEAST_TRANSMITTANCE
        weight = np.where(is_live, alpha * transmittance, 0)
        image += weight * (colors[i] + texel[..., :3])
        transmittance = transmittance - weight
    return image + transmittance * np.asarray(background)


def falloff(rho, exponent):
    """Return a kernel at squared distances: that of a Gaussian if the exponent is 1."""
    growth = lambda x: (x + 0.02) ** exponent - 0.02**exponent  # noqa: E731
    return np.exp(-growth(rho) / growth(2.0))


def rotations(quats):
    """Return matrices [N, 3, 3]."""
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.moveaxis(np.array(rows), 2, 0)


def intersected(homography, x, y):
    """Return u, v and the squared distance of pixels: of their rays' hits, or twice that from the centre if less."""
    first = x[..., None] * homography[2] - homography[0]
    second = y[..., None] * homography[2] - homography[1]
    p = np.cross(first, second)
    u, v = p[..., 0] / p[..., 2], p[..., 1] / p[..., 2]
    depth = homography[2, 0] * u + homography[2, 1] * v + homography[2, 2]
    is_hit = depth >= NEAR_PLANE
    u, v = np.where(is_hit, u, 0), np.where(is_hit, v, 0)
    center = homography[:2, 2] / homography[2, 2]
    rho_screen = 2 * ((x - center[0]) ** 2 + (y - center[1]) ** 2)
    return u, v, np.where(is_hit, np.minimum(u * u + v * v, rho_screen), rho_screen)


def looked_up(texture, u, v, uv):
    """Return values [..., 4] of a texture [Tv, Tu, 4] from -1 to 1."""
    places = []
    for coordinate, size in ((v, texture.shape[0]), (u, texture.shape[1])):
        unit = (coordinate + 1) / 2
        place = np.clip(unit * (size - 1) if uv == "align-corners" else unit * size - 0.5, 0, size - 1)
        low = np.floor(place).astype(int)
        places.append((low, np.minimum(low + 1, size - 1), (place - low)[..., None]))
    (top, bottom, down), (left, right, along) = places
    above = texture[top, left] * (1 - along) + texture[top, right] * along
    below = texture[bottom, left] * (1 - along) + texture[bottom, right] * along
    return above * (1 - down) + below * down


def own_colors(sh, offsets):
    """Return colours [N, 3] of coefficients [N, 16, 3], seen from the camera's position along offsets [N, 3]."""
    x, y, z = (offsets / np.linalg.norm(offsets, axis=1, keepdims=True)).T
    basis = [
        0.28209479177387814 + 0 * x,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    return np.maximum(np.einsum("bn,nbc->nc", basis, sh) + 0.5, 0)
