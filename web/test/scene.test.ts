import { expect, test } from "vitest";

import { at } from "../src/arrays";
import type { Chunk } from "../src/chunks";
import { ChunkReader } from "../src/chunks";
import { crc32 } from "../src/crc32";
import { HEAD_BYTES, SceneError, fixedColumns, parseHead, parseHeader } from "../src/format";
import type { Header, Quantity } from "../src/format";
import { HARMONIC_TEXELS, Packer, mostHarmonics } from "../src/packing";
import { fromBytes, readScene } from "../src/source";
import { NUMBERS, SHAPED, SMALL } from "./small";

const NUM = NUMBERS.degrees.length;

async function read(bytes: Uint8Array<ArrayBuffer>): Promise<{ header: Header; chunks: Chunk[] }> {
  const chunks: Chunk[] = [];
  const headers: Header[] = [];
  await readScene(fromBytes(bytes), {
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
function changed(changes: Record<string, unknown>, cut = 0): Uint8Array<ArrayBuffer> {
  const head = parseHead(SMALL);
  const text = new TextDecoder().decode(SMALL.subarray(HEAD_BYTES, HEAD_BYTES + head.headerBytes));
  const header = new TextEncoder().encode(JSON.stringify({ ...(JSON.parse(text) as object), ...changes }));
  const body = SMALL.subarray(HEAD_BYTES + head.headerBytes, SMALL.length - cut);
  const bytes = new Uint8Array(HEAD_BYTES + header.length + body.length);
  bytes.set(SMALL.subarray(0, 10));
  const view = new DataView(bytes.buffer);
  [header.length, body.length, crc32(header)].forEach((number, i) => {
    view.setUint32(10 + 4 * i, number, true);
  });
  bytes.set(header, HEAD_BYTES);
  bytes.set(body, HEAD_BYTES + header.length);
  return bytes;
}

const SH = ["sh_0", "sh_1", "sh_2", "sh_3"] as const;
const byteOf = (words: Uint32Array, place: number, index: number): number => (at(words, place) >>> (8 * index)) & 255;

test("crc32 equals zlib's", () => {
  expect(crc32(new TextEncoder().encode("123456789"))).toBe(0xcbf43926);
});

test("the header describes the file", async () => {
  const { header, chunks } = await read(SMALL);
  expect(header.num).toBe(NUM);
  expect([header.title, header.note, header.cameras[0]?.name]).toEqual(["small", "a note", "<b>a</b>.png"]);
  expect(header.background).toEqual([0.25, 0.5, 0.75]);
  expect(chunks.length).toBeGreaterThan(1);
  expect(chunks.reduce((sum, chunk) => sum + chunk.num, 0)).toBe(NUM);
});

test("packed rows equal those of the Python reader", async () => {
  const { header, chunks } = await read(SMALL);
  const packer = new Packer(header);
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
      expect([words[6], words[7]]).toEqual([texel, harmonic]);
      for (let k = 1; row < 40 && k < (degree + 1) ** 2; k++) {
        const band = at(SH, Math.floor(Math.sqrt(k)));
        const place = 4 * (harmonic - at(packed.rows, 7)) + k - 1;
        for (let c = 0; c < 3; c++) {
          near(value(band, byteOf(packed.harmonics, place, c)), at(NUMBERS.sh, 48 * row + 3 * k + c));
        }
      }
      for (let t = texel; t < Math.min(texel + width * height, 100); t++) {
        const codes = packed.texels.subarray(4 * (t - at(packed.rows, 6)));
        for (let c = 0; c < 3; c++) {
          const root = value("colors", at(codes, c));
          near(root * Math.abs(root), at(NUMBERS.texels, 4 * t + c));
        }
        near(value("alphas", at(codes, 3)), at(NUMBERS.texels, 4 * t + 3));
      }
      texel += width * height;
      harmonic += at(HARMONIC_TEXELS, degree);
    }
  }
  expect(row).toBe(NUM);
  expect(texel).toBe(header.numTexels);
  expect(harmonic).toBeLessThanOrEqual(mostHarmonics(header));
});

test.each([1, 7, 1000, 1e6])("bytes may arrive in pieces of %i", async (size) => {
  const { header, chunks } = await read(SMALL);
  const head = parseHead(SMALL);
  const coded = new Blob([SMALL.subarray(HEAD_BYTES + head.headerBytes)]).stream();
  const body = new Uint8Array(await new Response(coded.pipeThrough(new DecompressionStream("deflate"))).arrayBuffer());
  expect(body.length).toBe(header.bytes);
  const reader = new ChunkReader(header);
  const found: Chunk[] = [];
  for (let i = 0; i < body.length; i += size) found.push(...reader.push(body.subarray(i, i + size)));
  reader.end();
  expect(found).toEqual(chunks);
  expect(() => reader.push(new Uint8Array(1))).toThrow(SceneError);
});

test("shapes of kernels take a column more, and a byte of the packed rows", async () => {
  const { header, chunks } = await read(SHAPED);
  expect([header.hasShapes, fixedColumns(header)]).toEqual([true, 19]);
  const packer = new Packer(header);
  for (const chunk of chunks) {
    const { rows } = packer.pack(chunk);
    expect(new Set(chunk.shapes).size).toBe(chunk.num);
    chunk.shapes.forEach((code, i) => expect(byteOf(rows, 8 * i + 3, 3)).toBe(code));
  }
  expect((await read(SMALL)).header.hasShapes).toBe(false);
});

test("truncated files are rejected", async () => {
  for (const length of [0, 5, HEAD_BYTES, HEAD_BYTES + 30, SMALL.length >> 1, SMALL.length - 1]) {
    await expect(read(SMALL.slice(0, length))).rejects.toThrow(SceneError);
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

test.each([
  { num: 1 << 24 },
  { num: -1 },
  { num: 1.5 },
  { num: "3" },
  { num_texels: 1 << 25 },
  { num_texels: -2 },
  { chunk: 0 },
  { bytes: 2 ** 40 },
  { bytes: 10 },
  { base_degree: 4 },
  { num_bands: 0 },
  { num_bands: 9 },
  { means: [] },
  {
    means: [
      [1, 2, 3, 4],
      [1, 2, 3, 4],
      [1, 2, 3, null],
    ],
  },
  { ends: 3 },
  { ends: { colors: [0] } },
  { cameras: [{}] },
  { cameras: [3] },
  { uv: "elsewhere" },
  { outside: null },
  { max_alpha: 2 },
  { near_plane: 0 },
  { background: "red" },
  { title: 3 },
  { note: null },
])("invalid headers are rejected: %o", async (changes) => {
  await expect(read(changed(changes))).rejects.toThrow(SceneError);
});

test("rows that contradict the header are rejected", async () => {
  expect((await read(changed({}))).header.num).toBe(NUM);
  for (const changes of [
    { num: NUM - 1 },
    { num: NUM + 1 },
    { num_texels: null },
    { num_bands: 3 },
    { base_degree: 2 },
  ]) {
    await expect(read(changed(changes))).rejects.toThrow(SceneError);
  }
});

test("memory is allocated only for data that the file can hold", () => {
  const head = parseHead(SMALL);
  const header = parseHeader(SMALL.subarray(HEAD_BYTES, HEAD_BYTES + head.headerBytes), head);
  expect(fixedColumns(header)).toBe(18);
  expect(header.bytes).toBeLessThanOrEqual(1 << 24);
  expect(() =>
    parseHead(Uint8Array.from(SMALL.subarray(0, HEAD_BYTES), (byte, i) => (i >= 10 && i < 14 ? 255 : byte))),
  ).toThrow(SceneError);
});

test("the header names the camera at which the viewer opens", async () => {
  expect((await read(SMALL)).header.first).toBe(0);
  const [camera] = (await read(SMALL)).header.cameras;
  const raw = { name: "a", is_test: false, size: camera?.size, viewmat: camera?.viewmat, K: camera?.K };
  expect((await read(changed({ cameras: [raw, raw], first: 1 }))).header.first).toBe(1);
  await expect(read(changed({ cameras: [raw, raw], first: 2 }))).rejects.toThrow("first");
});
