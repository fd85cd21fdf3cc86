// node gaussian_splats_3d.mjs OTHERS FILE DEGREE prints what GaussianSplats3D reads of a *.ksplat, *.splat or *.ply:
// for each splat position, scales, rotation (wxyz), RGB and opacity in bytes, coefficients above degree 0 (RGB of each).
import fs from "node:fs";
import path from "node:path";
import { pathToFileURL } from "node:url";

const [, , others, file, degree] = process.argv;
const module = "node_modules/@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js";
globalThis.window = globalThis;
const { KSplatLoader, PlyLoader, SplatLoader } = await import(pathToFileURL(path.resolve(others, module)));
const loader = { ".ksplat": KSplatLoader, ".splat": SplatLoader, ".ply": PlyLoader }[path.extname(file)];
const bytes = new Uint8Array(fs.readFileSync(file)).buffer;
const splats = await loader.loadFromFileData(bytes, 0, 0, true, +degree);
const width = [0, 9, 24][degree];
const rest = new Float32Array(splats.getSplatCount() * width);
splats.fillSphericalHarmonicsArray(rest, +degree, undefined, 0, splats.getSplatCount() - 1, 0, 0);
const receiver = () => ({
  copy({ x, y, z, w }) { Object.assign(this, { x, y, z, w }); },
  set(x, y, z, w) { Object.assign(this, { x, y, z, w }); },
});
const rows = Array.from({ length: splats.getSplatCount() }, (_, i) => {
  const [center, scale, turn, color] = [receiver(), receiver(), receiver(), receiver()];
  splats.getSplatCenter(i, center);
  splats.getSplatScaleAndRotation(i, scale, turn);
  splats.getSplatColor(i, color);
  return [
    center.x, center.y, center.z, scale.x, scale.y, scale.z, turn.w, turn.x, turn.y, turn.z,
    color.x, color.y, color.z, color.w, ...rest.subarray(i * width, (i + 1) * width),
  ];
});
console.log(JSON.stringify(rows));
