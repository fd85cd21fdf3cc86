/** Loading of a scene, embedded in the page or in a file beside it, as a stream of bytes. */

import { ChunkReader } from "./chunks";
import type { Chunk } from "./chunks";
import { HEAD_BYTES, SceneError, parseHead, parseHeader } from "./format";
import type { Header } from "./format";

export const SCENE_FILE = "scene.a2tgw";

export interface Source {
  readonly bytes: ReadableStream<Uint8Array<ArrayBuffer>>;
  /** Length of the whole file in bytes; null if unknown in advance. */
  readonly length: number | null;
}

/** Open the scene embedded in the page, else the file beside it. Throws a SceneError if there is neither. */
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
  readonly onHeader: (header: Header, numBytes: number) => void;
  /** Handler called for each chunk. Reading continues when the promise resolves. */
  readonly onChunk: (chunk: Chunk, numBytesRead: number) => Promise<void>;
}

/** Read a whole scene. Throws a SceneError if it is damaged, before allocating memory for missing data. */
export async function readScene(source: Source, listener: Listener): Promise<void> {
  const { bytes, length } = source.length === null ? await gathered(source.bytes) : source;
  const reader = bytes.getReader();
  const start = await firstBytes(reader, HEAD_BYTES);
  const head = parseHead(start);
  const announced = HEAD_BYTES + head.headerBytes + head.bodyBytes;
  if (length !== announced) {
    await reader.cancel();
    throw new SceneError(`The scene is cut off or damaged: it has ${length} bytes, but should have ${announced}.`);
  }
  const more = await firstBytes(reader, HEAD_BYTES + head.headerBytes, start);
  const header = headerOf(more.subarray(HEAD_BYTES, HEAD_BYTES + head.headerBytes), head);
  listener.onHeader(header, announced);
  await readBody(reader, more.subarray(HEAD_BYTES + head.headerBytes), header, listener);
}

function headerOf(text: Uint8Array, head: ReturnType<typeof parseHead>): Header {
  try {
    return parseHeader(text, head);
  } catch (error) {
    throw error instanceof SceneError ? error : new SceneError("The scene is damaged: its header cannot be read.");
  }
}

type Reader = ReadableStreamDefaultReader<Uint8Array<ArrayBuffer>>;

async function readBody(
  reader: Reader,
  first: Uint8Array<ArrayBuffer>,
  header: Header,
  listener: Listener,
): Promise<void> {
  let numRead = first.length;
  const coded = new ReadableStream<Uint8Array<ArrayBuffer>>({
    start: (controller) => controller.enqueue(first),
    pull: async (controller) => {
      const { value, done } = await reader.read();
      if (done) {
        controller.close();
        return;
      }
      numRead += value.length;
      controller.enqueue(value);
    },
    cancel: () => reader.cancel(),
  });
  const chunks = new ChunkReader(header);
  try {
    const pieces = coded.pipeThrough(new DecompressionStream("deflate")).getReader();
    for (let piece = await pieces.read(); !piece.done; piece = await pieces.read()) {
      for (const chunk of chunks.push(piece.value)) await listener.onChunk(chunk, numRead);
    }
  } catch (error) {
    throw error instanceof SceneError ? error : new SceneError("The scene is damaged: it cannot be decompressed.");
  }
  chunks.end();
}

/** Read until at least `num` bytes are there, counting those of `before`. */
async function firstBytes(
  reader: Reader,
  num: number,
  before: Uint8Array = new Uint8Array(0),
): Promise<Uint8Array<ArrayBuffer>> {
  const pieces: Uint8Array[] = [before];
  let total = before.length;
  while (total < num) {
    const { value, done } = await reader.read();
    if (done) throw new SceneError("The scene is cut off within its header.");
    pieces.push(value);
    total += value.length;
  }
  const joined = new Uint8Array(total);
  let place = 0;
  for (const piece of pieces) {
    joined.set(piece, place);
    place += piece.length;
  }
  return joined;
}

async function gathered(bytes: Source["bytes"]): Promise<Source> {
  const blob = await new Response(bytes).blob();
  return { bytes: blob.stream(), length: blob.size };
}
