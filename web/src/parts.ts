/** Bytes of a compact scene as they arrive, and its parts one after the other. */

import { joined } from "./arrays";
import { crc32 } from "./crc32";
import { SceneError, damaged } from "./format";
import type { Coding } from "./format";

/** A stream of bytes, read in pieces of chosen lengths. */
export class ByteReader {
  numRead = 0;
  /** Checksum of all bytes since it was last set to 0. */
  checksum = 0;
  private readonly reader: ReadableStreamDefaultReader<Uint8Array<ArrayBuffer>>;
  private rest = new Uint8Array(0);

  constructor(bytes: ReadableStream<Uint8Array<ArrayBuffer>>) {
    this.reader = bytes.getReader();
  }

  /** Return the next bytes. Throws a SceneError if the stream ends before. */
  async take(num: number): Promise<Uint8Array<ArrayBuffer>> {
    const pieces: Uint8Array[] = [];
    for (let missing = num; missing > 0;) {
      if (this.rest.length === 0) {
        const { value, done } = await this.reader.read().catch(() => {
          throw new SceneError("The connection was lost before the whole scene had arrived. Reload the page.");
        });
        if (done) throw new SceneError("The scene is cut off.");
        this.rest = value;
      }
      const piece = this.rest.subarray(0, missing);
      pieces.push(piece);
      missing -= piece.length;
      this.rest = this.rest.subarray(piece.length);
    }
    const found = joined(pieces);
    this.numRead += num;
    this.checksum = crc32(found, this.checksum);
    return found;
  }

  /** Throw a SceneError if there are further bytes. */
  async end(): Promise<void> {
    if (this.rest.length > 0 || !(await this.reader.read()).done) throw damaged("there is data after the last part");
  }

  cancel(): Promise<void> {
    return this.reader.cancel();
  }
}

/** Decompress a stream of zlib to `size` bytes. Throws a SceneError if it holds more or less, or is damaged. */
export async function inflated(data: Uint8Array<ArrayBuffer>, size: number): Promise<Uint8Array<ArrayBuffer>> {
  const pieces = new Blob([data]).stream().pipeThrough(new DecompressionStream("deflate")).getReader();
  const found = new Uint8Array(size);
  let filled = 0;
  try {
    for (let piece = await pieces.read(); !piece.done; piece = await pieces.read()) {
      found.set(piece.value, filled); // Throws a RangeError beyond the end.
      filled += piece.value.length;
    }
  } catch {
    throw damaged("it cannot be decompressed");
  }
  if (filled !== size) throw damaged(`a part has ${filled} bytes instead of ${size}`);
  return found;
}

/** Reads the parts of a file in their order. */
export class PartReader {
  private readonly bytes: ByteReader;
  private readonly codings: Iterator<Coding>;
  private room: number;

  /** @param room - largest number of bytes to unpack */
  constructor(bytes: ByteReader, codings: readonly Coding[], room: number) {
    this.bytes = bytes;
    this.codings = codings.values();
    this.room = room;
  }

  /** Read [numPlanes, length] bytes. */
  async planes(name: string, numPlanes: number, length: number): Promise<Uint8Array<ArrayBuffer>> {
    const next = this.codings.next();
    if (next.done === true || next.value.name !== name) throw damaged(`the part ${name} is missing`);
    const { coder, numBytes } = next.value;
    const size = numPlanes * length;
    this.room -= size;
    if (this.room < 0) throw damaged(`${name} would take more bytes than the file has room for`);
    const data = await this.bytes.take(numBytes);
    if (coder === "deflate" && size > 0) return inflated(data, size);
    if (data.length !== size) throw damaged(`${name} has ${data.length} bytes instead of ${size}`);
    return data;
  }

  /** Read integers below `count`, of which one takes no bytes. */
  async indices(name: string, length: number, count: number): Promise<Uint16Array> {
    const planes = await this.planes(name, Math.ceil((32 - Math.clz32(count - 1)) / 8), length);
    const found = new Uint16Array(length);
    planes.forEach((byte, i) => (found[i % length]! |= byte << (8 * Math.floor(i / length))));
    if (found.some((index) => index >= count)) throw damaged(`${name} has an index out of range`);
    return found;
  }

  /** Read numbers whose bytes come in planes, the lowest ones first. */
  async exact<T>(
    name: string,
    num: number,
    kind: { readonly BYTES_PER_ELEMENT: number; new (b: ArrayBuffer): T },
  ): Promise<T> {
    const size = kind.BYTES_PER_ELEMENT;
    const planes = await this.planes(name, size, num);
    const bytes = new Uint8Array(size * num);
    planes.forEach((byte, i) => (bytes[(i % num) * size + Math.floor(i / num)] = byte));
    return new kind(bytes.buffer);
  }

  end(): void {
    if (this.codings.next().done !== true) throw damaged("it has parts that are not known");
  }
}
