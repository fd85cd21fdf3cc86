/** Head and header of *.a2tgw files (docs/formats.md). Every value is checked before use. */

import type { Intrinsics, Viewmat } from "./camera";
import { crc32 } from "./crc32";
import { isVector } from "./math";
import type { Vec2, Vec3 } from "./math";

export const MAGIC = [0x61, 0x32, 0x74, 0x67, 0x77, 0x0d, 0x0a, 0x1a];
/** Versions of files without and with shapes of kernels. */
export const VERSIONS = [1, 2];
export const HEAD_BYTES = 22;
const MOST_ROWS = 1 << 24;
const LARGEST_HEADER = 1 << 24;
const LARGEST_RATIO = 64;
const FREE_ROOM = 1 << 20;

/** An error whose message is shown to the user as it is. */
export class SceneError extends Error {
  override name = "SceneError";
}

export interface Head {
  readonly headerBytes: number;
  readonly bodyBytes: number;
  readonly checksum: number;
}

export interface SceneCamera {
  readonly name: string;
  readonly isTest: boolean;
  readonly size: Vec2;
  readonly viewmat: Viewmat;
  readonly K: Intrinsics;
}

/** Affine map from codes to values: low + step · code. */
export interface Ends {
  readonly low: number;
  readonly step: number;
}

/** Quantized values, as the header names them. */
export type Quantity =
  "log_scales" | "quats" | "opacities" | "sh_0" | "sh_1" | "sh_2" | "sh_3" | "colors" | "alphas" | "shapes";

/** Quantization of one axis of the means: centre, spread, first and last step. */
export type Axis = readonly [number, number, number, number];

export interface Header {
  readonly title: string;
  readonly note: string;
  readonly num: number;
  readonly chunk: number;
  readonly baseDegree: number;
  readonly numBands: number;
  /** Total number of texels; null without textures. */
  readonly numTexels: number | null;
  /** Whether kernels have shapes of their own. */
  readonly hasShapes: boolean;
  readonly bytes: number;
  readonly nearPlane: number;
  readonly maxAlpha: number;
  readonly uv: "texel-centre" | "align-corners";
  readonly outside: "clamp" | "identity";
  readonly means: readonly [Axis, Axis, Axis];
  readonly ends: Readonly<Record<Quantity, Ends>>;
  readonly background: Vec3;
  readonly cameras: readonly SceneCamera[];
  /** Index of the camera at which the viewer opens. */
  readonly first: number;
}

/** Read the first 22 bytes. Throws a SceneError unless they start a scene file of this version. */
export function parseHead(bytes: Uint8Array): Head {
  if (bytes.length < HEAD_BYTES || MAGIC.some((byte, i) => bytes[i] !== byte)) {
    throw new SceneError("This is not a scene file of a2tg view (*.a2tgw).");
  }
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const version = view.getUint16(8, true);
  if (!VERSIONS.includes(version)) {
    const known = VERSIONS.join(" and ");
    throw new SceneError(`The scene file has version ${version}; this viewer reads versions ${known}.`);
  }
  const head = {
    headerBytes: view.getUint32(10, true),
    bodyBytes: view.getUint32(14, true),
    checksum: view.getUint32(18, true),
  };
  if (head.headerBytes > LARGEST_HEADER) throw damaged(`its header claims ${head.headerBytes} bytes`);
  return head;
}

/** Read and check the header. Throws a SceneError if a field is missing or out of range. */
export function parseHeader(text: Uint8Array, head: Head): Header {
  if (crc32(text) !== head.checksum) throw damaged("the checksum of its header does not match");
  const raw = new Fields(JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(text)), "the header");
  const cameras = raw.isNull("cameras") ? [] : raw.list("cameras").map(cameraOf);
  const header: Header = {
    title: raw.text("title"),
    note: raw.text("note"),
    num: raw.count("num", 0, MOST_ROWS),
    chunk: raw.count("chunk", 1, MOST_ROWS),
    baseDegree: raw.count("base_degree", 0, 3),
    numBands: raw.count("num_bands", 1, 4),
    numTexels: raw.isNull("num_texels") ? null : raw.count("num_texels", 0, MOST_ROWS),
    hasShapes: raw.fields("ends").has("shapes"),
    bytes: raw.count("bytes", 0, FREE_ROOM + LARGEST_RATIO * head.bodyBytes),
    nearPlane: raw.between("near_plane", 0, 1e9),
    maxAlpha: raw.between("max_alpha", 0, 1),
    uv: raw.oneOf("uv", ["texel-centre", "align-corners"]),
    outside: raw.oneOf("outside", ["clamp", "identity"]),
    means: meansOf(raw.list("means", 3)),
    ends: endsOf(raw.fields("ends")),
    background: vector<Vec3>(raw.list("background"), 3, "background"),
    cameras,
    first: raw.has("first") ? raw.count("first", 0, Math.max(cameras.length - 1, 0)) : 0,
  };
  const leastBytes = 16 * header.num + 4 * (header.numTexels ?? 0);
  if (header.bytes < leastBytes) throw damaged("its header claims more rows than bytes");
  if (header.baseDegree >= header.numBands) throw damaged("base_degree is not below num_bands");
  return header;
}

/** Return the bytes per row in the first part of a chunk: 6 of means, 9 of numbers, degree, texture sizes, shape. */
export const fixedColumns = ({ numTexels, hasShapes }: Header): number =>
  16 + (numTexels === null ? 0 : 2) + Number(hasShapes);

function meansOf(axes: readonly unknown[]): Header["means"] {
  const axis = (i: number): Axis => vector<Axis>(axes[i], 4, `means[${i}]`);
  return [axis(0), axis(1), axis(2)];
}

function endsOf(raw: Fields): Header["ends"] {
  const ends = (name: Quantity, bits: number): Ends => {
    const [low, high] = raw.has(name) ? vector<Vec2>(raw.list(name), 2, name) : [0, 0];
    return { low, step: (high - low) / (2 ** bits - 1) };
  };
  return {
    log_scales: ends("log_scales", 8),
    quats: ends("quats", 8),
    opacities: ends("opacities", 8),
    sh_0: ends("sh_0", 8),
    sh_1: ends("sh_1", 7),
    sh_2: ends("sh_2", 6),
    sh_3: ends("sh_3", 6),
    colors: ends("colors", 8),
    alphas: ends("alphas", 8),
    shapes: ends("shapes", 8),
  };
}

function cameraOf(value: unknown, index: number): SceneCamera {
  const raw = new Fields(value, `cameras[${index}]`);
  const camera = {
    name: raw.text("name"),
    isTest: raw.flag("is_test"),
    size: vector<Vec2>(raw.list("size"), 2, "size"),
    viewmat: vector<Viewmat>(raw.list("viewmat"), 16, "viewmat"),
    K: vector<Intrinsics>(raw.list("K"), 9, "K"),
  };
  if (!(camera.size[0] >= 1 && camera.size[1] >= 1 && camera.K[0] > 0 && camera.K[4] > 0)) {
    throw damaged(`the size or focal length of camera ${index} is out of range`);
  }
  return camera;
}

function vector<T extends readonly number[]>(values: unknown, length: T["length"], name: string): T {
  if (!isVector<T>(values, length)) throw damaged(`${name} must be ${length} finite numbers`);
  return values;
}

const damaged = (what: string): SceneError => new SceneError(`The scene is damaged: ${what}.`);

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

  isNull(name: string): boolean {
    return this.get(name) === null;
  }

  text(name: string): string {
    const value = this.get(name);
    return typeof value === "string" ? value : this.wrong(name);
  }

  flag(name: string): boolean {
    const value = this.get(name);
    return typeof value === "boolean" ? value : this.wrong(name);
  }

  between(name: string, above: number, below: number): number {
    const value = this.get(name);
    return typeof value === "number" && value > above && value < below ? value : this.wrong(name);
  }

  count(name: string, least: number, most: number): number {
    const value = this.get(name);
    const isCount = typeof value === "number" && Number.isInteger(value) && value >= least && value <= most;
    return isCount ? value : this.wrong(name);
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

  private get(name: string): unknown {
    return this.has(name) ? this.values[name] : this.wrong(name);
  }

  private wrong(name: string): never {
    throw damaged(`${name} in ${this.where} is missing or out of range`);
  }
}
