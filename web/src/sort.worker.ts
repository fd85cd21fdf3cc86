/** Worker that keeps the positions and sorts them off the main thread. */

import type { Row4 } from "./math";
import { DepthSorter } from "./sort";

export interface AddMessage {
  readonly kind: "add";
  /** [n, 3] positions to append. */
  readonly means: Float32Array<ArrayBuffer>;
  /** Number of positions in the whole scene. */
  readonly total: number;
}

export interface SortMessage {
  readonly kind: "sort";
  readonly row: Row4;
}

export interface OrderMessage {
  /** Indices, padded to a multiple of four. */
  readonly order: Uint32Array<ArrayBuffer>;
  readonly num: number;
  readonly row: Row4;
}

const sorter = new DepthSorter();
let means = new Float32Array(0);
let num = 0;

self.addEventListener("message", (event: MessageEvent<AddMessage | SortMessage>) => {
  const message = event.data;
  if (message.kind === "add") {
    if (means.length === 0) means = new Float32Array(3 * message.total);
    means.set(message.means, 3 * num);
    num += message.means.length / 3;
    return;
  }
  const order = sorter.sort(means, num, message.row);
  const answer: OrderMessage = { order, num, row: message.row };
  self.postMessage(answer, { transfer: [order.buffer] });
});
