/** Head and header of *.a2tgz files (docs/formats.md). Every value is checked before use. */

import { at } from "./arrays";
import type { Intrinsics, Viewmat } from "./camera";
import { HARMONIC_TEXELS } from "./packing";
import { isVector, normalize } from "./math";
import type { Vec2, Vec3 } from "./math";

export const MAGIC = [0x61, 0x32, 0x74, 0x67, 0x7a, 0x0d, 0x0a, 0x1a];
export const VERSION = 3;
export const HEAD_BYTES = 22;
/** Name of the parts with the scores of floaters. */
export const FLOATERS = "floaters";
/** Name of the parts that mark the splats of the subject. */
export const SUBJECT = "subject";
const MOST_ROWS = 1 << 24;
const LARGEST_HEADER = 1 << 24;
const LARGEST_RATIO = 64;
const FREE_ROOM = 1 << 20;
const LARGEST_SIDE = 16;
/** Values of files that do not name them. */
const [NEAR_PLANE, MAX_ALPHA, EXTENT] = [0.2, 0.99, 3];

/** An error whose message is shown to the user as it is. */
export class SceneError extends Error {
  override name = "SceneError";
}

export interface Head {
  /** Bytes of the header, compressed and as text. */
  readonly codedBytes: number;
  readonly textBytes: number;
  /** Checksum of all that follows. */
  readonly checksum: number;
}

/** A part of the file. */
export interface Coding {
  readonly name: string;
  readonly coder: "deflate" | "none";
  readonly numBytes: number;
}

export interface SceneCamera {
  readonly name: string;
  readonly isTest: boolean;
  readonly size: Vec2;
  readonly viewmat: Viewmat;
  readonly K: Intrinsics;
}

/** Affine map from codes to values: low + step · code, up to high. */
export interface Ends {
  readonly low: number;
  readonly high: number;
  readonly step: number;
}

/** Quantized values, as the header names them. */
export type Quantity =
  "log_scales" | "quats" | "opacities" | "sh_0" | "sh_1" | "sh_2" | "sh_3" | "texel_colors" | "texel_alphas" | "shapes";

/** Quantization of one axis of the means: centre, spread, first and last step. */
export type Axis = readonly [number, number, number, number];

/** What the header itself says. */
export interface FileHeader {
  readonly title: string;
  readonly note: string;
  readonly num: number;
  readonly chunk: number;
  /** Degrees of the spherical harmonics that occur. */
  readonly degrees: readonly number[];
  readonly numBands: number;
  /** Number of groups of four words that the packed coefficients take. */
  readonly numHarmonics: number;
  /** Texture sizes Tv, Tu that occur; null without textures. */
  readonly sizes: readonly Vec2[] | null;
  readonly numTexels: number;
  /** Whether kernels differ in shape. */
  readonly hasShapes: boolean;
  readonly hasFloaters: boolean;
  readonly hasSubject: boolean;
  /** How sure the subject is, or why there is none; empty if it was not looked for. */
  readonly subject: string;
  readonly nearPlane: number;
  readonly maxAlpha: number;
  /** Half the side of a texture, in standard deviations. */
  readonly extent: number;
  readonly uv: "texel-centre" | "align-corners";
  readonly outside: "clamp" | "identity";
  readonly meanBits: number;
  readonly means: readonly [Axis, Axis, Axis];
  readonly ends: Readonly<Record<Quantity, Ends>>;
  readonly background: Vec3;
  /** Names of the cameras; null for a scene without an origin. */
  readonly names: readonly string[] | null;
  /** The vertical that was chosen; null if it is estimated from the cameras. */
  readonly up: Vec3 | null;
  /** Index of the camera at which the viewer opens. */
  readonly first: number;
  readonly parts: readonly Coding[];
  /** Bytes of the whole file. */
  readonly numBytes: number;
  /** Largest number of bytes that the parts may unpack to. */
  readonly room: number;
}

export interface Header extends FileHeader {
  readonly cameras: readonly SceneCamera[];
}

/** Read the first 22 bytes. Throws a SceneError unless they start a scene file of this version. */
export function parseHead(bytes: Uint8Array): Head {
  if (bytes.length < HEAD_BYTES || MAGIC.some((byte, i) => bytes[i] !== byte)) {
    throw new SceneError("This is not a scene file of a2tg view (*.a2tgz).");
  }
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const version = view.getUint16(8, true);
  if (version !== VERSION) {
    throw new SceneError(`The scene file has version ${version}; this viewer reads version ${VERSION}.`);
  }
  const head = {
    codedBytes: view.getUint32(10, true),
    textBytes: view.getUint32(14, true),
    checksum: view.getUint32(18, true),
  };
  const largest = Math.max(head.codedBytes, head.textBytes);
  if (largest > LARGEST_HEADER) throw damaged(`its header claims ${largest} bytes`);
  return head;
}

/** Read and check the header. Throws a SceneError if a field is missing or out of range. */
export function parseHeader(text: Uint8Array, head: Head): FileHeader {
  const raw = new Fields(JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(text)), "the header");
  const parts = raw.list("parts").map(codingOf);
  const numBytes = parts.reduce((sum, part) => sum + part.numBytes, HEAD_BYTES + head.codedBytes);
  const origin = raw.has("origin") ? raw.fields("origin") : null;
  const names = origin?.texts("names") ?? null;
  const appearance = raw.fields("appearance");
  const kinds = appearance.fields("parts");
  const texture = raw.has("sizes") ? kinds.fields("texture").fields("options") : null;
  const own = appearance.fields("options").get("max_alpha") === null ? texture : appearance.fields("options");
  const baseDegree = raw.count("base_degree", 0, 3);
  const numBands = kinds.has("bands") ? 4 : baseDegree + 1;
  const num = raw.count("num", 0, MOST_ROWS);
  const degrees = raw.counts("degrees", baseDegree, numBands - 1);
  const sizes = raw.has("sizes") ? raw.list("sizes").map(sizeOf) : null;
  const degreeCounts = raw.counts("degree_counts", 0, num, degrees.length);
  const sizeCounts = sizes === null ? [] : raw.counts("size_counts", 0, num, sizes.length);
  const page = raw.has("page") ? raw.fields("page") : null;
  const choices = raw.fields("choices");
  const numTexels = sizeCounts.reduce((sum, count, i) => sum + count * area(at(sizes ?? [], i)), 0);
  const header: FileHeader = {
    title: page?.text("title") ?? "",
    note: page?.text("note") ?? "",
    num,
    chunk: raw.count("chunk", 1, MOST_ROWS),
    degrees,
    numBands,
    numHarmonics: degreeCounts.reduce((sum, count, i) => sum + count * at(HARMONIC_TEXELS, at(degrees, i)), 0),
    sizes,
    numTexels,
    hasShapes: kinds.has("exponents"),
    hasFloaters: parts.some(({ name }) => name === FLOATERS),
    hasSubject: parts.some(({ name }) => name === SUBJECT),
    subject: page?.has("subject") === true ? page.text("subject") : "",
    nearPlane: page?.between("near_plane", 0, 1e9) ?? NEAR_PLANE,
    maxAlpha: own?.between("max_alpha", 0, 1) ?? MAX_ALPHA,
    extent: texture?.has("extent") === true ? texture.between("extent", 0, 1e9) : EXTENT,
    uv: texture?.oneOf("uv", ["texel-centre", "align-corners"]) ?? "texel-centre",
    outside: texture?.oneOf("outside", ["clamp", "identity"]) ?? "clamp",
    meanBits: bitsOf(choices, "means", 16),
    means: meansOf(raw.fields("ends").list("means", 12)),
    ends: endsOf(raw.fields("ends"), choices),
    background: vector<Vec3>(raw.list("background"), 3, "background"),
    names,
    up: origin?.has("up") === true ? normalize(vector<Vec3>(origin.list("up"), 3, "up")) : null,
    first: page?.has("first") === true ? page.count("first", 0, Math.max((names?.length ?? 0) - 1, 0)) : 0,
    parts,
    numBytes,
    room: FREE_ROOM + LARGEST_RATIO * numBytes,
  };
  if (texture !== null) {
    texture.oneOf("rgb", ["signed"]);
    texture.oneOf("alpha", ["projected"]);
  }
  // Bytes of all numbers, so that memory for them is allocated for files only that can hold them.
  const numMarks = Number(header.hasShapes) + Number(header.hasFloaters) + Number(header.hasSubject);
  const perRow = Math.ceil((3 * header.meanBits) / 8) + 9 + numMarks;
  const coefficients = degreeCounts.reduce((sum, count, i) => sum + count * ((at(degrees, i) + 1) ** 2 - 1), 0);
  const leastBytes = perRow * num + 3 * coefficients + 4 * numTexels + 204 * (names?.length ?? 0);
  if (numTexels > MOST_ROWS || leastBytes > header.room) throw damaged("its header claims more rows than bytes");
  for (const counts of [degreeCounts, ...(sizes === null ? [] : [sizeCounts])]) {
    if (counts.reduce((sum, count) => sum + count, 0) !== num) throw damaged("its counts of rows do not match");
  }
  return header;
}

function codingOf(value: unknown): Coding {
  const [name, coder, numBytes] = Array.isArray(value) ? (value as unknown[]) : [];
  if (typeof name !== "string" || !isCount(numBytes, 0, Number.MAX_SAFE_INTEGER)) throw damaged("a part has no name");
  if (coder !== "deflate" && coder !== "none") {
    throw new SceneError(`The scene uses the coder ${String(coder)}, which browsers lack: use a2tg export --web.`);
  }
  return { name, coder, numBytes };
}

function sizeOf(value: unknown): Vec2 {
  const [height, width] = Array.isArray(value) ? (value as unknown[]) : [];
  if (!isCount(height, 0, LARGEST_SIDE) || !isCount(width, 0, LARGEST_SIDE) || (height === 0) !== (width === 0)) {
    throw damaged("a texture size is out of range");
  }
  return [height, width];
}

const area = ([height, width]: Vec2): number => height * width;

function bitsOf(choices: Fields, name: string, most: number): number {
  const bits = choices.get(name);
  if (isCount(bits, 1, most)) return bits;
  throw new SceneError(`The viewer shows ${name} of 1 to ${most} bits, not ${String(bits)}: use a2tg export --web.`);
}

function meansOf(ends: readonly unknown[]): Header["means"] {
  const axis = (i: number): Axis => vector<Axis>(ends.slice(4 * i, 4 * i + 4), 4, `axis ${i} of the means`);
  return [axis(0), axis(1), axis(2)];
}

function endsOf(raw: Fields, choices: Fields): Header["ends"] {
  const ends = (name: Quantity, choice: string = name): Ends => {
    const [low, high] = raw.has(name) ? vector<Vec2>(raw.list(name), 2, name) : [0, 0];
    return { low, high, step: (high - low) / (2 ** bitsOf(choices, choice, 8) - 1) };
  };
  return {
    log_scales: ends("log_scales"),
    quats: ends("quats"),
    opacities: ends("opacities"),
    sh_0: ends("sh_0"),
    sh_1: ends("sh_1", "sh_rest"),
    sh_2: ends("sh_2", "sh_rest"),
    sh_3: ends("sh_3", "sh_rest"),
    texel_colors: ends("texel_colors", "texels"),
    texel_alphas: ends("texel_alphas", "texels"),
    shapes: ends("shapes"),
  };
}

function vector<T extends readonly number[]>(values: unknown, length: T["length"], name: string): T {
  if (!isVector<T>(values, length)) throw damaged(`${name} must be ${length} finite numbers`);
  return values;
}

const isCount = (value: unknown, least: number, most: number): value is number =>
  typeof value === "number" && Number.isInteger(value) && value >= least && value <= most;

export const damaged = (what: string): SceneError => new SceneError(`The scene is damaged: ${what}.`);

/** An untrusted JSON object whose fields are checked as they are read. */
class Fields {
  private readonly values: Readonly<Record<string, unknown>>;
  private readonly where: string;

  constructor(value: unknown, where: string) {
    if (typeof value !== "object" || value === null || Array.isArray(value)) throw damaged(`${where} is not an object`);
    this.values = value as Readonly<Record<string, unknown>>;
    this.where = where;
  }

  has(name: string): boolean {
    return Object.hasOwn(this.values, name);
  }

  text(name: string): string {
    const value = this.get(name);
    return typeof value === "string" ? value : this.wrong(name);
  }

  texts(name: string): string[] {
    const values = this.list(name);
    return values.every((value) => typeof value === "string") ? values : this.wrong(name);
  }

  between(name: string, above: number, below: number): number {
    const value = this.get(name);
    return typeof value === "number" && value > above && value < below ? value : this.wrong(name);
  }

  count(name: string, least: number, most: number): number {
    const value = this.get(name);
    return isCount(value, least, most) ? value : this.wrong(name);
  }

  counts(name: string, least: number, most: number, length?: number): number[] {
    const values = this.list(name, length);
    return values.every((value) => isCount(value, least, most)) ? values : this.wrong(name);
  }

  oneOf<T extends string>(name: string, choices: readonly T[]): T {
    return choices.find((choice) => choice === this.get(name)) ?? this.wrong(name);
  }

  list(name: string, length?: number): unknown[] {
    const value: unknown = this.get(name);
    if (!Array.isArray(value)) return this.wrong(name);
    return length === undefined || value.length === length ? (value as unknown[]) : this.wrong(name);
  }

  fields(name: string): Fields {
    return new Fields(this.get(name), name);
  }

  get(name: string): unknown {
    return this.has(name) ? this.values[name] : this.wrong(name);
  }

  private wrong(name: string): never {
    throw damaged(`${name} in ${this.where} is missing or out of range`);
  }
}
