"""Flags of each command, so that a misspelt one is reported without importing the commands.

Written by docs/scripts/options.py.
"""

FLAGS = {
    "demo": "out overwrite quiet resume",
    "train": (
        "alpha background base-degree baseline batch-size billboard.alpha billboard.rgb billboard.side compare config "
        "coordinator corrections.affine.final-factor corrections.affine.rate corrections.exposure-kind "
        "corrections.grid.final-factor corrections.grid.rate corrections.grid.size corrections.grid.smoothness "
        "corrections.pose.final-factor corrections.pose.rate densify.cap densify.dense-share densify.largest-share "
        "densify.least-opacity densify.threshold details.anisotropic details.at details.axes details.budget-mb "
        "details.cap details.fraction details.gradient details.k-a details.k-s details.moments details.select "
        "details.threshold devices downscale empty-textures exponents.least exposure fading-weight file-budget "
        "floaters.at floaters.least floaters.min-views floaters.near heartbeat-timeout-seconds init initial-gaussians "
        "initial-opacity kernel-rate kernels.centers kernels.colors kernels.logit-opacities kernels.sharpness lens "
        "lookup.alpha lookup.extent lookup.initial-rgb lookup.max-alpha lookup.outside lookup.rgb lookup.uv "
        "lookup.uv-gradient loss.depth-kind loss.depth-weight loss.distortion-weight loss.normal-weight "
        "loss.opacity-weight loss.robust-factor loss.robust-share loss.scale-weight loss.ssim-weight lpips-weights "
        "mask-as max-memory memory-budget more noise-in-stage2 num-processes on-nan opacity-reset.most out overwrite "
        "place.at place.cap place.share preset process-id prune.at prune.keep prune.share quiet rates.log-scales "
        "rates.logit-opacities rates.means rates.means-final-factor rates.quats rates.sh-degree0 rates.sh-rest "
        "refine-poses resume seed sh-degree single-texel-rate stage1-iterations stage2-iterations system tensorboard "
        "test-every texel-rate texture-share texture-side texture.anisotropic texture.at texture.axes "
        "texture.budget-mb texture.cap texture.fraction texture.gradient texture.k-a texture.k-s texture.moments "
        "texture.select texture.threshold tile-size validation view view-dependence-rate view-dependence-share "
        "view-dependence.at view-dependence.budget-mb view-dependence.highest view-dependence.idle yes "
    ),
    "eval": "json lpips-weights",
    "finish": "lpips-weights max-loss out polish-steps",
    "render": "edit fps frames model out overwrite path size supersample",
    "mesh": "clusters edit faces max-memory model out overwrite radius resolution texture texture-size unbounded voxel",
    "view": "edit host model open port",
    "export": "edit model overwrite photographs single-file title web",
    "convert": "bake bake-growth bake-iterations edit float64 model overwrite world",
    "edit": "background crop floaters model out overwrite upright",
    "compare": "out overwrite",
    "compress": "file-budget max-loss out overwrite tune-iterations verbose",
    "info": "json",
    "sfm": "camera-model frames masks matching out panorama",
    "download": "list out",
    "doctor": "",
}
