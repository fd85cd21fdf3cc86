/**
 * Repacking of chunks for the shader. Each row takes 32 bytes, two texels of four 32-bit words:
 *
 *     x, y, z as floats | degree 0: red, green, blue; shape of the kernel
 *     quaternion x, y, z; opacity | log-scale u, v; Tu + 32 Tv + 1024 degree + 4096 subject | first texel of its
 *     texture; score of floaters, highest | first word of its harmonics
 *
 * Each coefficient above degree 0 takes one word (red, green, blue, unused), padded to groups of four. Each texel takes
 * four words, so that one fetch reads all that an interpolation needs: itself, its right neighbour, the one below, and
 * the one right of that, each of them red, green, blue, alpha. Neighbours beyond the edge are those at the edge.
 */

import type { Chunk } from "./chunks";

export const ROW_WORDS = 8;
/** Bit of the sixth word of a row that marks the subject. */
export const SUBJECT_BIT = 1 << 28;
/** Number of groups of four words for the coefficients above degree 0, by degree. */
export const HARMONIC_TEXELS = [0, 1, 2, 4] as const;
const COEFFICIENTS = [0, 3, 8, 15] as const;

export interface Packed {
  readonly num: number;
  /** [n, 3] positions. */
  readonly means: Float32Array<ArrayBuffer>;
  /** [n, 8] words of rows. */
  readonly rows: Uint32Array;
  /** [h, 4] words of harmonics. */
  readonly harmonics: Uint32Array;
  /** [t, 4] words of texels. */
  readonly texels: Uint32Array;
}

/** Packs successive chunks, counting texels and harmonics across them. */
export class Packer {
  private numTexels = 0;
  private numHarmonics = 0;

  pack(chunk: Chunk): Packed {
    const rows = new Uint32Array(ROW_WORDS * chunk.num);
    const floats = new Float32Array(rows.buffer);
    const { num, means, numbers, degrees, sizes, shapes, floaters, subject } = chunk;
    let texel = this.numTexels;
    let harmonic = this.numHarmonics;
    for (let i = 0; i < num; i++) {
      const place = ROW_WORDS * i;
      const byte = (column: number): number => numbers[column * num + i]!;
      const green = byte(7);
      floats.set(means.subarray(3 * i, 3 * i + 3), place);
      rows[place + 3] = word(byte(6) + green, green, byte(8) + green, shapes[i]!);
      rows[place + 4] = word(byte(2), byte(3), byte(4), byte(5));
      const packed = sizes[num + i]! | (sizes[i]! << 5) | (degrees[i]! << 10) | ((subject[i]! & 1) << 12);
      rows[place + 5] = word(byte(0), byte(1), packed, packed >> 8);
      rows[place + 6] = (texel & 0xffffff) | (floaters[i]! << 24);
      rows[place + 7] = harmonic;
      texel += sizes[i]! * sizes[num + i]!;
      harmonic += HARMONIC_TEXELS[degrees[i]!]!;
    }
    const packed = {
      num,
      means,
      rows,
      harmonics: harmonicsOf(chunk, harmonic - this.numHarmonics),
      texels: texelsOf(chunk),
    };
    this.numTexels = texel;
    this.numHarmonics = harmonic;
    return packed;
  }
}

/** Pack four numbers modulo 256 into a word, the first one lowest. */
function word(a: number, b: number, c: number, d: number): number {
  return ((a & 255) | ((b & 255) << 8) | ((c & 255) << 16) | ((d & 255) << 24)) >>> 0;
}

/** Reorder coefficients by row. The file orders them by band, colour and coefficient. */
function harmonicsOf(chunk: Chunk, numGroups: number): Uint32Array {
  const words = new Uint32Array(4 * numGroups);
  const places = new Uint32Array(chunk.num);
  let place = 0;
  for (let i = 0; i < chunk.num; i++) {
    places[i] = place;
    place += 4 * HARMONIC_TEXELS[chunk.degrees[i]!]!;
  }
  chunk.bands.forEach((band, index) => {
    const degree = index + 1;
    const size = 2 * degree + 1;
    const count = band.length / (3 * size);
    let j = 0;
    for (let i = 0; i < chunk.num; i++) {
      if (chunk.degrees[i]! < degree) continue;
      for (let k = 0; k < size; k++) {
        const green = band[(size + k) * count + j]!;
        const to = places[i]! + COEFFICIENTS[degree - 1]! + k;
        words[to] = word(band[k * count + j]! + green, green, band[(2 * size + k) * count + j]! + green, 0);
      }
      j++;
    }
  });
  return words;
}

function texelsOf({ num, sizes, texels }: Chunk): Uint32Array {
  const count = texels.length / 4;
  const found = new Uint32Array(4 * count);
  const own = new Uint32Array(count);
  for (let i = 0; i < count; i++) {
    const green = texels[count + i]!;
    own[i] = word(texels[i]! + green, green, texels[2 * count + i]! + green, texels[3 * count + i]!);
  }
  let first = 0;
  for (let i = 0; i < num; i++) {
    const [height, width] = [sizes[i]!, sizes[num + i]!];
    for (let y = 0; y < height; y++) {
      const above = first + y * width;
      const below = first + Math.min(y + 1, height - 1) * width;
      for (let x = 0; x < width; x++) {
        const right = Math.min(x + 1, width - 1);
        const place = 4 * (above + x);
        found[place] = own[above + x]!;
        found[place + 1] = own[above + right]!;
        found[place + 2] = own[below + x]!;
        found[place + 3] = own[below + right]!;
      }
    }
    first += width * height;
  }
  return found;
}
