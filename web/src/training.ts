/** Live training: shows its progress, loads new scenes, pauses and resumes it. */

import { bytesText, countText, element, setText } from "./page";

const STATUS_FILE = "training.json";
const PERIOD = 1000;

/** Status of the training, as the server reports it. */
export interface Status {
  /** Number of scenes so far. */
  readonly version: number;
  readonly message: string;
  readonly stage: string;
  readonly isPaused: boolean;
  /** Whether what is left is done in a tenth of the steps. */
  readonly isFinishing: boolean;
  readonly iterations: number;
  readonly iteration: number;
  /** NaN before iteration 10, like the fields below. */
  readonly loss: number;
  /** NaN also if it is infinite. */
  readonly psnr: number;
  readonly num: number;
  readonly bytes: number;
}

/** Parse a status. Returns null if `value` is none. */
export function statusOf(value: unknown): Status | null {
  if (typeof value !== "object" || value === null) return null;
  const fields = value as Readonly<Record<string, unknown>>;
  const number = (name: string, otherwise: number): number => {
    const found = fields[name];
    return typeof found === "number" && Number.isFinite(found) ? found : otherwise;
  };
  const text = (name: string): string => (typeof fields[name] === "string" ? fields[name] : "");
  if (!Number.isInteger(fields.version)) return null;
  return {
    version: number("version", 0),
    message: text("message"),
    stage: text("stage"),
    isPaused: fields.is_paused === true,
    isFinishing: fields.is_finishing === true,
    iterations: number("iterations", 0),
    iteration: number("iteration", 0),
    loss: number("loss", NaN),
    psnr: number("psnr", NaN),
    num: number("num", NaN),
    bytes: number("bytes", NaN),
  };
}

export function statusText(status: Status): string {
  if (status.message !== "") return status.message;
  if (Number.isNaN(status.loss)) {
    return status.stage === "" ? "Training is starting." : `Stage ${status.stage} is starting.`;
  }
  const state = status.isPaused ? ", paused" : status.isFinishing ? ", finishing" : "";
  const psnr = Number.isNaN(status.psnr) ? "" : `${status.psnr.toFixed(2)} dB, `;
  return (
    `${status.stage}: ${countText(status.iteration)} of ${countText(status.iterations)}${state}. ` +
    `Loss ${status.loss.toFixed(4)}, ${psnr}${countText(status.num)} Gaussians, ${bytesText(status.bytes)}.`
  );
}

async function ask(path: string, method: "GET" | "POST"): Promise<Status | null> {
  try {
    const response = await fetch(path, { method, cache: "no-store" });
    return response.ok ? statusOf(await response.json()) : null;
  } catch {
    return null;
  }
}

/**
 * Follow a training until it ends. Resolves to false at once if there is none.
 *
 * @param show - loads and shows the current scene
 */
export async function followTraining(show: () => Promise<void>): Promise<boolean> {
  let status = await ask(STATUS_FILE, "GET");
  if (status === null) return false;
  element("training", HTMLElement).hidden = false;
  const button = element("pause", HTMLButtonElement);
  const finish = element("finish", HTMLButtonElement);
  const send = (path: string): void => {
    void ask(path, "POST").then((found) => {
      if (found !== null) tell(found);
    });
  };
  button.addEventListener("click", () => {
    send(button.dataset.paused === "yes" ? "resume" : "pause");
  });
  finish.addEventListener("click", () => {
    send("finish");
  });
  for (let version = 0; status !== null; status = await ask(STATUS_FILE, "GET")) {
    tell(status);
    if (status.version > version) {
      version = status.version;
      await show();
    }
    await new Promise((resolve) => setTimeout(resolve, PERIOD));
  }
  button.disabled = true;
  finish.disabled = true;
  setText("state", "The training has ended or cannot be reached. To see the result, run a2tg view.");
  return true;
}

function tell(status: Status): void {
  setText("state", statusText(status));
  const bar = element("trained", HTMLProgressElement);
  [bar.max, bar.value] = [Math.max(status.iterations, 1), status.iteration];
  const button = element("pause", HTMLButtonElement);
  button.textContent = status.isPaused ? "Resume" : "Pause";
  button.dataset.paused = status.isPaused ? "yes" : "no";
  element("finish", HTMLButtonElement).disabled = status.isFinishing;
}
