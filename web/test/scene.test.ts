import { deflateSync } from "node:zlib";

import { expect, test } from "vitest";

import { at } from "../src/arrays";
import type { Chunk } from "../src/chunks";
import { crc32 } from "../src/crc32";
import { HEAD_BYTES, SceneError, parseHead } from "../src/format";
import type { Header, Quantity } from "../src/format";
import { HARMONIC_TEXELS, Packer } from "../src/packing";
import { ByteReader } from "../src/parts";
import { fromBytes, readScene } from "../src/source";
import type { Source } from "../src/source";
import { NUMBERS, SHAPED, SMALL, headerText } from "./small";

const SH: readonly Quantity[] = ["sh_0", "sh_1", "sh_2", "sh_3"];
const NUM = NUMBERS.degrees.length;
type Fields = Record<string, unknown>;
const FIELDS = JSON.parse(headerText(SMALL)) as Fields & Record<"page" | "ends" | "choices" | "appearance", Fields>;

async function read(source: Uint8Array<ArrayBuffer> | Source): Promise<{ header: Header; chunks: Chunk[] }> {
  const chunks: Chunk[] = [];
  const headers: Header[] = [];
  await readScene(source instanceof Uint8Array ? fromBytes(source) : source, {
    onHeader: (found) => headers.push(found),
    onChunk: (chunk) => {
      chunks.push(chunk);
      return Promise.resolve();
    },
  });
  expect(headers.length).toBe(1);
  return { header: at(headers, 0), chunks };
}

/** Return the small scene with fields of its header replaced and `cut` bytes of its body removed. */
function changed(changes: Fields, cut = 0): Uint8Array<ArrayBuffer> {
  const text = new TextEncoder().encode(JSON.stringify({ ...FIELDS, ...changes }));
  const coded = deflateSync(text);
  const body = SMALL.subarray(HEAD_BYTES + parseHead(SMALL).codedBytes, SMALL.length - cut);
  const bytes = new Uint8Array(HEAD_BYTES + coded.length + body.length);
  bytes.set(SMALL.subarray(0, 10));
  bytes.set(coded, HEAD_BYTES);
  bytes.set(body, HEAD_BYTES + coded.length);
  const view = new DataView(bytes.buffer);
  [coded.length, text.length, crc32(bytes.subarray(HEAD_BYTES))].forEach((number, i) => {
    view.setUint32(10 + 4 * i, number, true);
  });
  return bytes;
}

const byteOf = (words: Uint32Array, place: number, index: number): number => (at(words, place) >>> (8 * index)) & 255;

test("crc32 equals zlib's, of pieces too", () => {
  const bytesOf = (text: string): Uint8Array => new TextEncoder().encode(text);
  expect(crc32(bytesOf("56789"), crc32(bytesOf("1234")))).toBe(0xcbf43926);
});

test("the header describes the file", async () => {
  const { header, chunks } = await read(SMALL);
  expect([header.num, header.first, header.hasShapes]).toEqual([NUM, 0, false]);
  expect([header.title, header.note, header.cameras[0]?.name]).toEqual(["small", "a note", "<b>a</b>.png"]);
  expect([header.cameras[0]?.size, header.cameras[0]?.viewmat[11]]).toEqual([[64, 48], 4]);
  expect(header.background).toEqual([0.25, 0.5, 0.75]);
  expect(chunks.length).toBeGreaterThan(1);
  expect(chunks.reduce((sum, chunk) => sum + chunk.num, 0)).toBe(NUM);
});

test("packed rows equal those of the Python reader", async () => {
  const { header, chunks } = await read(SMALL);
  const packer = new Packer();
  const near = (found: number, wanted: number): void =>
    expect(Math.abs(found - wanted)).toBeLessThan(3e-5 * (1 + Math.abs(wanted)));
  const value = (name: Quantity, code: number): number => header.ends[name].low + code * header.ends[name].step;
  let [row, texel, harmonic] = [0, 0, 0];
  for (const chunk of chunks) {
    const packed = packer.pack(chunk);
    const floats = new Float32Array(packed.rows.buffer);
    for (let i = 0; i < packed.num; i++, row++) {
      const words = packed.rows.subarray(8 * i, 8 * i + 8);
      for (let k = 0; k < 3; k++) {
        near(at(packed.means, 3 * i + k), at(NUMBERS.means, 3 * row + k));
        expect(at(floats, 8 * i + k)).toBe(at(packed.means, 3 * i + k));
        near(value("quats", byteOf(words, 4, k)), at(NUMBERS.quats, 4 * row + k + 1));
        if (row < 40) near(value("sh_0", byteOf(words, 3, k)), at(NUMBERS.sh, 48 * row + k));
      }
      const sides = at(words, 5) >>> 16;
      const degree = sides >> 10;
      expect(byteOf(words, 3, 3)).toBe(at(chunk.shapes, i));
      expect(degree).toBe(NUMBERS.degrees[row]);
      near(value("opacities", byteOf(words, 4, 3)), at(NUMBERS.opacities, row));
      for (let k = 0; k < 2; k++) near(value("log_scales", byteOf(words, 5, k)), at(NUMBERS.log_scales, 2 * row + k));
      const [width, height] = [sides & 31, (sides >> 5) & 31];
      expect([height, width]).toEqual(NUMBERS.sizes.slice(2 * row, 2 * row + 2));
      expect([at(words, 6) & 0xffffff, words[7]]).toEqual([texel, harmonic]);
      expect(byteOf(words, 6, 3)).toBe(at(chunk.floaters, i));
      for (let k = 1; row < 40 && k < (degree + 1) ** 2; k++) {
        const band = at(SH, Math.floor(Math.sqrt(k)));
        const place = 4 * (harmonic - at(packed.rows, 7)) + k - 1;
        for (let c = 0; c < 3; c++) {
          near(value(band, byteOf(packed.harmonics, place, c)), at(NUMBERS.sh, 48 * row + 3 * k + c));
        }
      }
      for (let t = texel; t < Math.min(texel + width * height, 100); t++) {
        const place = 4 * (t - (at(packed.rows, 6) & 0xffffff));
        for (let c = 0; c < 3; c++) {
          near(value("texel_colors", byteOf(packed.texels, place, c)), at(NUMBERS.texels, 4 * t + c));
        }
        near(value("texel_alphas", byteOf(packed.texels, place, 3)), at(NUMBERS.texels, 4 * t + 3));
        const right = (t - texel) % width < width - 1 ? 4 : 0;
        const below = t - texel < width * (height - 1) ? 4 * width : 0;
        const neighbours = [0, right, below, below + right].map((step) => packed.texels[place + step]);
        expect([...packed.texels.subarray(place, place + 4)]).toEqual(neighbours);
      }
      texel += width * height;
      harmonic += at(HARMONIC_TEXELS, degree);
    }
  }
  expect(row).toBe(NUM);
  expect(texel).toBe(header.numTexels);
  expect(harmonic).toBe(header.numHarmonics);
});

test.each([1, 7, 1000])("bytes may arrive in pieces of %i, of unknown number", async (size) => {
  const pieces = Array.from({ length: Math.ceil(SMALL.length / size) }, (_, i) =>
    SMALL.slice(i * size, (i + 1) * size),
  );
  const { chunks } = await read({ bytes: new Blob(pieces).stream(), length: null });
  expect(chunks).toEqual((await read(SMALL)).chunks);
  const reader = new ByteReader(new Blob(pieces).stream());
  expect(await reader.take(500)).toEqual(SMALL.slice(0, 500));
  await expect(reader.end()).rejects.toThrow("after the last part");
  await expect(read({ bytes: new Blob([SMALL, "x"]).stream(), length: null })).rejects.toThrow("after the last part");
});

test("shapes of kernels take a byte of the packed rows", async () => {
  const { header, chunks } = await read(SHAPED);
  expect(header.hasShapes).toBe(true);
  const packer = new Packer();
  for (const chunk of chunks) {
    const { rows } = packer.pack(chunk);
    expect(new Set(chunk.shapes).size).toBe(chunk.num);
    chunk.shapes.forEach((code, i) => expect(byteOf(rows, 8 * i + 3, 3)).toBe(code));
  }
});

test("a connection that breaks off is named, and what to do", async () => {
  const bytes = new ReadableStream<Uint8Array<ArrayBuffer>>({
    pull(controller) {
      controller.enqueue(SMALL.slice(0, 100));
      controller.error(new TypeError("network error"));
    },
  });
  await expect(
    readScene({ bytes, length: null }, { onHeader: () => undefined, onChunk: () => Promise.resolve() }),
  ).rejects.toThrow(/connection was lost .* Reload the page/);
});

test("truncated files are rejected", async () => {
  for (const length of [0, 5, HEAD_BYTES, HEAD_BYTES + 30, SMALL.length >> 1, SMALL.length - 1]) {
    await expect(read(SMALL.slice(0, length))).rejects.toThrow(SceneError);
    await expect(read({ ...fromBytes(SMALL.slice(0, length)), length: null })).rejects.toThrow(SceneError);
  }
  await expect(read(changed({}, 40))).rejects.toThrow(/damaged|cut off/);
});

test("every changed byte is detected", async () => {
  for (let place = 0; place < SMALL.length; place += 97) {
    const spoiled = SMALL.slice();
    spoiled[place] = at(spoiled, place) ^ 0x55;
    await expect(read(spoiled), `byte ${place}`).rejects.toThrow(SceneError);
  }
});

const { page, ends, choices, appearance } = FIELDS;
const parts = FIELDS.parts as [string, string, number][];
const described = appearance as { parts: { texture: { options: Fields } } };
const withTextures = (options: Fields): Fields => {
  const texture = { ...described.parts.texture, options: { ...described.parts.texture.options, ...options } };
  return { ...described, parts: { ...described.parts, texture } };
};
test.each([
  { num: 1 << 24 },
  { num: -1 },
  { num: 1.5 },
  { num: "3" },
  { num: NUM - 1 },
  { num: NUM + 1 },
  { size_counts: [NUM, 0, 0, 0, 0] },
  { size_counts: [1, 2] },
  { size_counts: [-1, 61, 60, 60, 120] },
  { sizes: [[16, 17]] },
  { sizes: [[0, 1]] },
  { chunk: 0 },
  { base_degree: 4 },
  { base_degree: 2 },
  { degrees: [0, 1, 2, 4] },
  { degrees: [0] },
  { degree_counts: [NUM, 0, 0, 0] },
  { degree_counts: [NUM] },
  { ends: 3 },
  { ends: { ...ends, means: [] } },
  { ends: { ...ends, means: [1, 2, 3, 4, 1, 2, 3, 4, 1, 2, 3, null] } },
  { ends: { ...ends, texel_colors: [0] } },
  { choices: { ...choices, means: 20 } },
  { choices: { ...choices, quats: "float32" } },
  { choices: { ...choices, sh_rest: 12 } },
  { origin: { names: [3] } },
  { origin: { names: ["a", "b"] } },
  { origin: { names: [] } },
  { appearance: { ...appearance, parts: {} } },
  { appearance: { ...appearance, options: { max_alpha: 2 } } },
  { appearance: withTextures({ extent: 0 }) },
  { appearance: withTextures({ extent: "3" }) },
  { appearance: withTextures({ extent: null }) },
  { page: { ...page, near_plane: 0 } },
  { page: { ...page, title: 3 } },
  { page: { ...page, note: null } },
  { page: { ...page, first: 2 } },
  { background: "red" },
  { parts: parts.slice(1) },
  { parts: parts.slice(0, -1) },
  { parts: parts.map(([name, , length]) => [name, "none", length]) },
  { parts: parts.map(([name, , length]) => [name, "lzma", length]) },
  { parts: parts.map(([name, coder, length]) => [name, coder, name === "quats" ? -1 : length]) },
])("headers that the file contradicts are rejected: %o", async (changes) => {
  await expect(read(changed(changes))).rejects.toThrow(SceneError);
});

test("textures have the extent that the header says, 3 without", async () => {
  expect(described.parts.texture.options).not.toHaveProperty("extent");
  expect((await read(SMALL)).header.extent).toBe(3);
  expect((await read(changed({ appearance: withTextures({ extent: 1.5 }) }))).header.extent).toBe(1.5);
});

test("headers may leave out what the viewer does without", async () => {
  expect((await read(changed({ page: undefined }))).header.nearPlane).toBe(0.2);
  const claimed = SMALL.slice(0, HEAD_BYTES).map((byte, i) => (i >= 10 && i < 14 ? 255 : byte));
  expect(() => parseHead(claimed)).toThrow(SceneError);
});
