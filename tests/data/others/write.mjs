// node write.mjs scene.ply out.ksplat LEVEL DEGREE SECTION_SIZE, in a folder where GaussianSplats3D and three are installed.
import fs from "fs";
globalThis.window = globalThis;
const { PlyLoader } = await import("@mkkellogg/gaussian-splats-3d");
const [, , input, output, level, degree, sectionSize] = process.argv;
const bytes = new Uint8Array(fs.readFileSync(input)).buffer;
const [minimumAlpha, center, blockSize, bucketSize] = [1, undefined, 4, 16];
const splats = await PlyLoader.loadFromFileData(
  bytes, minimumAlpha, +level, true, +degree, +sectionSize, center, blockSize, bucketSize);
fs.writeFileSync(output, Buffer.from(splats.bufferData));
const counts = splats.sections.map((s) => [s.splatCount, s.fullBucketCount, s.partiallyFilledBucketCount]);
console.log(output, "splats, full and other buckets of each section:", JSON.stringify(counts));
