/** A scene in GPU memory and the worker that sorts it. */

import type { Chunk } from "./chunks";
import type { Header } from "./format";
import { LongTexture } from "./gl";
import type { Row4 } from "./math";
import { Packer } from "./packing";
import SortWorker from "./sort.worker?worker&inline";
import type { AddMessage, OrderMessage, SortMessage } from "./sort.worker";

export class Splats {
  readonly header: Header;
  readonly rows: LongTexture;
  readonly harmonics: LongTexture;
  readonly texels: LongTexture;
  /** Indices of rows from the farthest to the nearest. */
  readonly order: LongTexture;
  readonly widthBits: number;
  /** Number of rows received. */
  num = 0;
  /** Number of rows in the current order. */
  numDrawn = 0;
  numTexels = 0;
  numBytes = 0;
  /** Handler for a new order. */
  onOrder: () => void = () => undefined;
  /** Handler for errors of the worker. */
  onFail: (reason: string) => void = () => undefined;

  private readonly packer = new Packer();
  private readonly worker: Worker;
  private isSorting = false;
  private wanted: Row4 | null = null;
  private sorted: { row: Row4; num: number } | null = null;
  private waiting: (() => void)[] = [];

  constructor(gl: WebGL2RenderingContext, header: Header) {
    this.header = header;
    this.widthBits = Math.min(12, Math.floor(Math.log2(gl.getParameter(gl.MAX_TEXTURE_SIZE) as number)));
    this.rows = new LongTexture(gl, 2 * header.num, this.widthBits, "Gaussians");
    this.harmonics = new LongTexture(gl, header.numHarmonics, this.widthBits, "colours");
    this.texels = new LongTexture(gl, header.numTexels, this.widthBits, "texels");
    this.order = new LongTexture(gl, Math.ceil(header.num / 4), this.widthBits, "Gaussians");
    this.worker = new SortWorker();
    this.worker.addEventListener("message", (event: MessageEvent<OrderMessage>) => this.receive(event.data));
    this.worker.addEventListener("error", (event) => this.onFail(event.message));
  }

  add(chunk: Chunk): void {
    const packed = this.packer.pack(chunk);
    this.rows.append(packed.rows);
    this.harmonics.append(packed.harmonics);
    this.texels.append(packed.texels);
    this.numBytes += packed.rows.byteLength + packed.harmonics.byteLength + packed.texels.byteLength;
    this.num += packed.num;
    this.numTexels += packed.texels.length / 4;
    const message: AddMessage = { kind: "add", means: packed.means, total: this.header.num };
    this.worker.postMessage(message, [packed.means.buffer]);
  }

  /** Request a sort by the depth row · (x, y, z, 1). A later request replaces a pending one. */
  sort(row: Row4): void {
    if (this.isSorted(row)) return;
    this.wanted = row;
    this.next();
  }

  /** Resolve once sorted by a row, whatever frames request meanwhile. */
  async sortNow(row: Row4): Promise<void> {
    while (!this.isSorted(row)) {
      this.sort(row);
      await this.settled();
    }
  }

  /** Resolve when the last request is done. */
  async settled(): Promise<void> {
    if (!this.isSorting && this.wanted === null) return;
    await new Promise<void>((resolve) => this.waiting.push(resolve));
  }

  delete(): void {
    this.worker.terminate();
    for (const texture of [this.order, this.rows, this.harmonics, this.texels]) texture.delete();
  }

  private isSorted(row: Row4): boolean {
    const { sorted } = this;
    return sorted !== null && sorted.num === this.num && row.every((x, i) => x === sorted.row[i]);
  }

  private next(): void {
    if (this.isSorting || this.wanted === null) return;
    const message: SortMessage = { kind: "sort", row: this.wanted };
    [this.isSorting, this.wanted] = [true, null];
    this.worker.postMessage(message);
  }

  private receive({ order, num, row }: OrderMessage): void {
    this.order.clear();
    this.order.append(order);
    this.numDrawn = num;
    this.sorted = { row, num };
    this.isSorting = false;
    if (this.wanted === null) {
      for (const resolve of this.waiting.splice(0)) resolve();
    }
    this.next();
    this.onOrder();
  }
}
