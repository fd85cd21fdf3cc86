/** Keeps the positions and answers with orders, so that drawing need not wait for sorting. */

import type { Row4 } from "./math";
import { DepthSorter } from "./sort";

export interface AddMessage {
  readonly kind: "add";
  /** [n, 3] further positions. */
  readonly means: Float32Array<ArrayBuffer>;
  /** How many there will be. */
  readonly total: number;
}

export interface SortMessage {
  readonly kind: "sort";
  readonly row: Row4;
}

export interface OrderMessage {
  readonly order: Uint32Array<ArrayBuffer>;
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
  const answer: OrderMessage = { order, row: message.row };
  self.postMessage(answer, { transfer: [order.buffer] });
});
