/**
 * Repacking of chunks for the shader. Each row takes 32 bytes, two texels of four 32-bit words:
 *
 *     x, y, z as floats | degree 0: red, green, blue; shape of the kernel
 *     quaternion x, y, z; opacity | log-scale u, v; Tu + 32 Tv + 1024 degree | first texel of its texture | first word
 *     of its harmonics
 *
 * Each coefficient above degree 0 takes one word (red, green, blue, unused), padded to groups of four. Each texel takes
 * four bytes.
 */

import type { Chunk } from "./chunks";

export const ROW_WORDS = 8;
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
  /** [t, 4] red, green, blue, alpha. */
  readonly texels: Uint8Array;
}

/** Packs successive chunks, counting texels and harmonics across them. */
export class Packer {
  private numTexels = 0;
  private numHarmonics = 0;

  pack(chunk: Chunk): Packed {
    const rows = new Uint32Array(ROW_WORDS * chunk.num);
    const floats = new Float32Array(rows.buffer);
    const { num, means, numbers, degrees, sizes, shapes } = chunk;
    let texel = this.numTexels;
    let harmonic = this.numHarmonics;
    for (let i = 0; i < num; i++) {
      const place = ROW_WORDS * i;
      const byte = (column: number): number => numbers[column * num + i]!;
      const green = byte(7);
      floats.set(means.subarray(3 * i, 3 * i + 3), place);
      rows[place + 3] = word(byte(6) + green, green, byte(8) + green, shapes[i]!);
      rows[place + 4] = word(byte(2), byte(3), byte(4), byte(5));
      const packed = sizes[num + i]! | (sizes[i]! << 5) | (degrees[i]! << 10);
      rows[place + 5] = word(byte(0), byte(1), packed, packed >> 8);
      rows[place + 6] = texel;
      rows[place + 7] = harmonic;
      texel += sizes[i]! * sizes[num + i]!;
      harmonic += HARMONIC_TEXELS[degrees[i]!]!;
    }
    const packed = {
      num,
      means,
      rows,
      harmonics: harmonicsOf(chunk, harmonic - this.numHarmonics),
      texels: texelsOf(chunk.texels),
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

function texelsOf(planes: Uint8Array): Uint8Array {
  const num = planes.length / 4;
  const found = new Uint8Array(planes.length);
  for (let i = 0; i < num; i++) {
    const green = planes[num + i]!;
    found[4 * i] = planes[i]! + green;
    found[4 * i + 1] = green;
    found[4 * i + 2] = planes[2 * num + i]! + green;
    found[4 * i + 3] = planes[3 * num + i]!;
  }
  return found;
}
