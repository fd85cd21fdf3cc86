/**
 * Reference reader of *.a2tgz files (docs/formats.md): all numbers of a scene, without a browser.
 *
 * The viewer itself leaves numbers in bytes (packing.ts). This module decodes them, and needs neither DOM nor WebGL.
 */

import { at } from "./arrays";
import type { Chunk } from "./chunks";
import type { Header, Quantity } from "./format";
import { fromBytes, readScene } from "./source";

/** Number of coefficients of degrees 0 to 3. */
const BASES = 16;
const BANDS: readonly Quantity[] = ["sh_1", "sh_2", "sh_3"];

/** N splats and T texels as numbers, rows one after the other. */
export interface Numbers {
  readonly header: Header;
  /** [N, 3]. */
  readonly means: Float32Array;
  /** [N, 4] unit quaternions w, x, y, z. */
  readonly quats: Float64Array;
  /** [N, 2]. */
  readonly logScales: Float64Array;
  /** [N]. */
  readonly opacities: Float64Array;
  /** [N] degrees of the spherical harmonics. */
  readonly degrees: Uint8Array;
  /** [N, 16, 3] coefficients; zeros above the degree. */
  readonly sh: Float64Array;
  /** [N, 2] rows and columns of the textures. */
  readonly sizes: Uint8Array;
  /** [T, 4] red, green, blue and alpha factor, one texture after the other. */
  readonly texels: Float64Array;
  /** [N] exponents of the kernels; 1 is a Gaussian. */
  readonly exponents: Float64Array;
}

/** Read a whole file. Throws a SceneError if it is damaged. */
export async function readNumbers(bytes: Uint8Array<ArrayBuffer>): Promise<Numbers> {
  const decoders: Decoder[] = [];
  await readScene(fromBytes(bytes), {
    onHeader: (header) => decoders.push(new Decoder(header)),
    onChunk: (chunk) => {
      at(decoders, 0).add(chunk);
      return Promise.resolve();
    },
  });
  return at(decoders, 0);
}

class Decoder implements Numbers {
  readonly header: Header;
  readonly means: Float32Array;
  readonly quats: Float64Array;
  readonly logScales: Float64Array;
  readonly opacities: Float64Array;
  readonly degrees: Uint8Array;
  readonly sh: Float64Array;
  readonly sizes: Uint8Array;
  readonly texels: Float64Array;
  readonly exponents: Float64Array;
  private numTexels = 0;

  constructor(header: Header) {
    const { num } = header;
    this.header = header;
    this.means = new Float32Array(3 * num);
    this.quats = new Float64Array(4 * num);
    this.logScales = new Float64Array(2 * num);
    this.opacities = new Float64Array(num);
    this.degrees = new Uint8Array(num);
    this.sh = new Float64Array(3 * BASES * num);
    this.sizes = new Uint8Array(2 * num);
    this.texels = new Float64Array(4 * header.numTexels);
    this.exponents = new Float64Array(num);
  }

  add(chunk: Chunk): void {
    const { start, num } = chunk;
    this.degrees.set(chunk.degrees, start);
    this.means.set(chunk.means, 3 * start);
    for (let i = 0; i < num; i++) this.row(chunk, i, start + i);
    chunk.bands.forEach((codes, index) => this.band(chunk, codes, index + 1));
    this.addTexels(chunk.texels);
  }

  /** Decode what each row has in bytes. */
  private row(chunk: Chunk, i: number, row: number): void {
    const code = (column: number): number => at(chunk.numbers, column * chunk.num + i);
    const xyz = [2, 3, 4].map((column) => this.value("quats", code(column)));
    const w = Math.sqrt(Math.max(1 - xyz.reduce((sum, x) => sum + x * x, 0), 0));
    this.quats.set([w, ...xyz], 4 * row);
    this.logScales.set([this.value("log_scales", code(0)), this.value("log_scales", code(1))], 2 * row);
    this.opacities[row] = this.value("opacities", code(5));
    this.sh.set(this.color("sh_0", code(6), code(7), code(8)), 3 * BASES * row);
    this.sizes.set([at(chunk.sizes, i), at(chunk.sizes, chunk.num + i)], 2 * row);
    this.exponents[row] = Math.exp(Math.min(Math.max(this.value("shapes", at(chunk.shapes, i)), -1), 1));
  }

  /** Decode the coefficients of one degree, which come by colour and order, of the rows of that degree or more. */
  private band(chunk: Chunk, codes: Uint8Array, degree: number): void {
    const size = 2 * degree + 1;
    const count = codes.length / (3 * size);
    let place = 0;
    for (let i = 0; i < chunk.num; i++) {
      if (at(chunk.degrees, i) < degree) continue;
      for (let order = 0; order < size; order++) {
        const code = (channel: number): number => at(codes, (channel * size + order) * count + place);
        const to = 3 * (BASES * (chunk.start + i) + degree * degree + order);
        this.sh.set(this.color(at(BANDS, degree - 1), code(0), code(1), code(2)), to);
      }
      place++;
    }
  }

  private addTexels(planes: Uint8Array): void {
    const num = planes.length / 4;
    for (let i = 0; i < num; i++) {
      const code = (channel: number): number => at(planes, channel * num + i);
      const color = this.color("texel_colors", code(0), code(1), code(2));
      this.texels.set([...color, this.value("texel_alphas", code(3))], 4 * this.numTexels++);
    }
  }

  private value(name: Quantity, code: number): number {
    const { low, step } = this.header.ends[name];
    return low + step * code;
  }

  /** Decode red and blue, which are kept less green, modulo 256. */
  private color(name: Quantity, red: number, green: number, blue: number): number[] {
    return [red + green, green, blue + green].map((code) => this.value(name, code & 255));
  }
}
