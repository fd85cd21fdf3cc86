/** Loading of a scene, embedded in the page or in a file next to it, as a stream of bytes. */

import { at } from "./arrays";
import type { Intrinsics, Viewmat } from "./camera";
import { readChunk } from "./chunks";
import type { Chunk } from "./chunks";
import { HEAD_BYTES, SceneError, damaged, parseHead, parseHeader } from "./format";
import type { FileHeader, Head, Header, SceneCamera } from "./format";
import { isVector } from "./math";
import type { Vec2 } from "./math";
import { HARMONIC_TEXELS } from "./packing";
import { ByteReader, PartReader, inflated } from "./parts";

export const SCENE_FILE = "scene.a2tgz";

export interface Source {
  readonly bytes: ReadableStream<Uint8Array<ArrayBuffer>>;
  /** Length of the whole file in bytes; null if unknown in advance. */
  readonly length: number | null;
}

/** Open the scene embedded in the page, else the file next to it. Throws a SceneError if there is neither. */
export async function openScene(): Promise<Source> {
  const held = document.getElementById("scene-data");
  if (held !== null) return fromBytes(fromBase64(held.textContent.trim()));
  let response: Response;
  try {
    response = await fetch(SCENE_FILE);
  } catch {
    throw new SceneError(
      location.protocol === "file:"
        ? "Serve this page from a web server: browsers do not let a page opened from disk read other files. " +
            "To get a page that opens from disk, run a2tg export RUN --web OUT.html."
        : `The scene file ${SCENE_FILE} could not be fetched.`,
    );
  }
  if (!response.ok || response.body === null) throw new SceneError(`There is no ${SCENE_FILE} beside this page.`);
  const length = Number(response.headers.get("Content-Length") ?? NaN);
  const isCoded = response.headers.has("Content-Encoding");
  return { bytes: response.body, length: Number.isFinite(length) && !isCoded ? length : null };
}

export function fromBytes(bytes: Uint8Array<ArrayBuffer>): Source {
  return { bytes: new Blob([bytes]).stream(), length: bytes.length };
}

function fromBase64(text: string): Uint8Array<ArrayBuffer> {
  try {
    return Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  } catch {
    throw new SceneError("The scene embedded in this page is damaged.");
  }
}

export interface Listener {
  /** Handler called once, before any chunk. */
  readonly onHeader: (header: Header) => void;
  /** Handler called for each chunk. Reading continues when the promise resolves. */
  readonly onChunk: (chunk: Chunk, numBytesRead: number) => Promise<void>;
}

/** Read a whole scene. Throws a SceneError if it is damaged, before allocating memory for missing data. */
export async function readScene({ bytes, length }: Source, listener: Listener): Promise<void> {
  const reader = new ByteReader(bytes);
  try {
    await readFrom(reader, length, listener);
  } finally {
    await reader.cancel().catch(() => undefined);
  }
}

async function readFrom(reader: ByteReader, length: number | null, listener: Listener): Promise<void> {
  const head = parseHead(await reader.take(HEAD_BYTES));
  reader.checksum = 0;
  const written = headerOf(await inflated(await reader.take(head.codedBytes), head.textBytes), head);
  if (length !== null && length !== written.numBytes) {
    throw new SceneError(
      `The scene is cut off or damaged: it has ${length} bytes, but should have ${written.numBytes}.`,
    );
  }
  const parts = new PartReader(reader, written.parts, written.room);
  const header = { ...written, cameras: await camerasOf(parts, written.names) };
  listener.onHeader(header);
  let [numTexels, numHarmonics] = [0, 0];
  for (let start = 0; start < Math.max(header.num, 1); start += header.chunk) {
    const chunk = await readChunk(parts, header, start);
    numTexels += chunk.texels.length / 4;
    for (const degree of chunk.degrees) numHarmonics += at(HARMONIC_TEXELS, degree);
    if (numTexels > header.numTexels || numHarmonics > header.numHarmonics) throw damaged("it has too many numbers");
    await listener.onChunk(chunk, reader.numRead);
  }
  parts.end();
  await reader.end();
  if (reader.checksum !== head.checksum) throw damaged("its checksum does not match");
}

function headerOf(text: Uint8Array, head: Head): FileHeader {
  try {
    return parseHeader(text, head);
  } catch (error) {
    throw error instanceof SceneError ? error : damaged("its header cannot be read");
  }
}

/** Read the cameras; further numbers of the origin are read and dropped. */
async function camerasOf(parts: PartReader, names: FileHeader["names"]): Promise<SceneCamera[]> {
  if (names === null) return [];
  const num = names.length;
  const viewmats = await parts.exact("origin_viewmats", 16 * num, Float64Array);
  const Ks = await parts.exact("origin_Ks", 9 * num, Float64Array);
  const sizes = await parts.exact("origin_sizes", 2 * num, Int32Array);
  const areTests = await parts.exact("origin_is_test", num, Uint8Array);
  for (const [name, count] of [
    ["scale", 1],
    ["rotation", 9],
    ["translation", 3],
  ] as const) {
    await parts.planes(`origin_${name}`, 8, count);
  }
  return names.map((name, i) => {
    const viewmat = Array.from(viewmats.subarray(16 * i, 16 * i + 16));
    const K = Array.from(Ks.subarray(9 * i, 9 * i + 9));
    const size = Array.from(sizes.subarray(2 * i, 2 * i + 2));
    const isRight = isVector<Viewmat>(viewmat, 16) && isVector<Intrinsics>(K, 9) && isVector<Vec2>(size, 2);
    if (!isRight || Math.min(size[0], size[1]) < 1 || Math.min(K[0], K[4]) <= 0) {
      throw damaged(`the numbers of camera ${i} are out of range`);
    }
    return { name, isTest: areTests[i] === 1, size, viewmat, K };
  });
}
