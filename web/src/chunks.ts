/** Chunks of consecutive rows, read from the parts of a file. */

import { at, joined } from "./arrays";
import { FLOATERS, SUBJECT, damaged } from "./format";
import type { Header, Quantity } from "./format";
import type { PartReader } from "./parts";

/** Columns of consecutive rows. Codes are bytes, encoded as in the file. */
export interface Chunk {
  /** Index of the first row. */
  readonly start: number;
  readonly num: number;
  /** [n, 3] positions. */
  readonly means: Float32Array<ArrayBuffer>;
  /** [9, n] log-scales u, v; quaternion x, y, z; opacity; degree 0: red − green, green, blue − green. */
  readonly numbers: Uint8Array;
  /** [n] degrees of the spherical harmonics. */
  readonly degrees: Uint8Array;
  /** [2, n] texture sizes Tv, Tu; zeros without textures. */
  readonly sizes: Uint8Array;
  /** [n] shapes of the kernels; zeros if all are Gaussians. */
  readonly shapes: Uint8Array;
  /** [n] scores of floaters; zeros without them. */
  readonly floaters: Uint8Array;
  /** [n] 1 for splats of the subject, else 0. */
  readonly subject: Uint8Array;
  /** Band l ≥ 1 at index l − 1: [3, 2l + 1, m] red − green, green, blue − green of the m rows of degree ≥ l. */
  readonly bands: readonly Uint8Array[];
  /** [4, t]: red − green, green, blue − green, alpha. */
  readonly texels: Uint8Array;
}

/** Read the next chunk, which starts at the given row. */
export async function readChunk(parts: PartReader, header: Header, start: number): Promise<Chunk> {
  const num = Math.min(header.chunk, header.num - start);
  const codes = async (name: Quantity, columns: number, length: number): Promise<Uint8Array> => {
    const isConstant = header.ends[name].step === 0; // Then there are no bytes.
    const planes = await parts.planes(name, isConstant ? 0 : columns, length);
    return isConstant ? new Uint8Array(columns * length) : planes;
  };
  const means = positions(await parts.planes("means", Math.ceil((3 * header.meanBits) / 8), num), num, header);
  const degreeIndices = await parts.indices("degrees", num, header.degrees.length);
  const degrees = Uint8Array.from(degreeIndices, (index) => at(header.degrees, index));
  const sizes = new Uint8Array(2 * num);
  let numTexels = 0;
  if (header.sizes !== null) {
    for (const [i, index] of (await parts.indices("sizes", num, header.sizes.length)).entries()) {
      const [height, width] = at(header.sizes, index);
      [sizes[i], sizes[num + i]] = [height, width];
      numTexels += height * width;
    }
  }
  const numbers = [await codes("log_scales", 2, num), await codes("quats", 3, num), await codes("opacities", 1, num)];
  numbers.push(await codes("sh_0", 3, num));
  const bands: Uint8Array[] = [];
  for (const [i, name] of (["sh_1", "sh_2", "sh_3"] as const).slice(0, header.numBands - 1).entries()) {
    const count = degrees.reduce((sum, degree) => sum + Number(degree > i), 0);
    bands.push(await codes(name, 3, (2 * i + 3) * count));
  }
  const texels =
    header.sizes === null ? [] : [await codes("texel_colors", 3, numTexels), await codes("texel_alphas", 1, numTexels)];
  const shapes = header.hasShapes ? await codes("shapes", 1, num) : new Uint8Array(num);
  const floaters = header.hasFloaters ? await parts.planes(FLOATERS, 1, num) : new Uint8Array(num);
  const subject = header.hasSubject ? await parts.planes(SUBJECT, 1, num) : new Uint8Array(num);
  return {
    start,
    num,
    means,
    numbers: joined(numbers),
    degrees,
    sizes,
    shapes,
    floaters,
    subject,
    bands,
    texels: joined(texels),
  };
}

/**
 * Return positions [n, 3] from the bytes of places along a Z curve, each less the one before. A place holds the bits of
 * the three axes by turns, up to 48 in all.
 */
function positions(planes: Uint8Array, num: number, { means, meanBits }: Header): Float32Array<ArrayBuffer> {
  const found = new Float32Array(3 * num);
  const powers = Array.from({ length: Math.ceil((3 * meanBits) / 8) }, (_, k) => 256 ** k);
  const axes = means.map(([centre, spread, low, high]) => ({
    centre,
    spread,
    low,
    step: (high - low) / (2 ** meanBits - 1),
  }));
  let place = 0;
  for (let i = 0; i < num; i++) {
    for (let k = 0; k < powers.length; k++) place += planes[k * num + i]! * powers[k]!;
    if (place >= 2 ** (3 * meanBits)) throw damaged("a position is out of range");
    const [lower, upper] = [place % 2 ** 24, Math.floor(place / 2 ** 24)];
    for (let axis = 0; axis < 3; axis++) {
      const { centre, spread, low, step } = axes[axis]!;
      const code = everyThird(lower >> axis) | (everyThird(upper >> axis) << 8);
      found[3 * i + axis] = centre + spread * Math.sinh(low + code * step);
    }
  }
  return found;
}

/** Return bits 0, 3, …, 21 next to each other. */
function everyThird(bits: number): number {
  let x = bits & 0x249249;
  x = (x | (x >> 2)) & 0x0c30c3;
  x = (x | (x >> 4)) & 0x00f00f;
  return (x | (x >> 8)) & 0x0000ff;
}
