/** Entry point: loads the scene, shows it as it arrives, and connects panel and viewer. */

import "./style.css";

import { lensOf, poseOf } from "./camera";
import type { Intrinsics, Viewmat } from "./camera";
import { SceneError } from "./format";
import { CONTEXT_LOST } from "./gl";
import { hasPanel } from "./link";
import type { Vec2 } from "./math";
import { bytesText, countText, element, setFigures, setText, showMessage } from "./page";
import { Panel } from "./panel";
import { MODES } from "./shaders";
import { openScene, readScene } from "./source";
import type { Source } from "./source";
import type { Splats } from "./splats";
import { followTraining } from "./training";
import { Viewer } from "./viewer";

/** Interface for other scripts, such as tests, as window.a2tg. */
export interface PageApi {
  /** Promise that resolves when the whole scene is loaded. */
  readonly loaded: Promise<void>;
  readonly viewer: Viewer;
  /** Render a view to [h, w, 4], rows from the top: premultiplied colours and alpha. */
  render(viewmat: Viewmat, K: Intrinsics, size: Vec2, mode: string): Promise<Float32Array>;
}

declare global {
  interface Window {
    a2tg?: PageApi;
  }
}

/** Growth of a loading scene after which it is sorted and drawn again. */
const GROWTH = 1.7;

async function load(viewer: Viewer, panel: Panel, source: Source): Promise<void> {
  const progress = element("progress", HTMLProgressElement);
  progress.hidden = false;
  let splats: Splats | null = null;
  let numShown = 0;
  const isFirst = viewer.splats === null;
  const reading = readScene(source, {
    onHeader: (header) => {
      splats = viewer.begin(header);
      if (isFirst) panel.begin(header);
      else panel.offerModes(header);
    },
    onChunk: async (chunk, numRead) => {
      if (splats === null) return;
      splats.add(chunk);
      progress.value = numRead / splats.header.numBytes;
      if (isFirst || splats.num === splats.header.num) tell(splats);
      if (numShown === 0 && isFirst) {
        viewer.splats = splats;
        panel.ready();
      }
      if (splats.num < GROWTH * numShown && splats.num < splats.header.num) return;
      viewer.sort(splats);
      // Show the first rows before reading on. A later scene replaces the current one only when complete.
      if (numShown === 0 && isFirst) await splats.settled().then(nextFrame);
      numShown = splats.num;
    },
  });
  const last = await reading.then(
    () => splats,
    (error: unknown) => {
      if (splats !== viewer.splats) splats?.delete();
      throw error;
    },
  );
  progress.hidden = true;
  if (last === null || last.num === 0) throw new SceneError("The scene is empty.");
  await last.settled();
}

/** Resolve after the next frame, or after 200 ms if the window is hidden and draws none. */
function nextFrame(): Promise<void> {
  return new Promise((resolve) => {
    requestAnimationFrame(() => setTimeout(resolve));
    setTimeout(resolve, 200);
  });
}

function tell(splats: Splats): void {
  const { header } = splats;
  const figures: [string, string][] = [
    [
      "Gaussians",
      splats.num < header.num ? `${countText(splats.num)} of ${countText(header.num)}` : countText(header.num),
    ],
    ["File", bytesText(header.numBytes)],
    ["GPU memory", bytesText(splats.numBytes)],
  ];
  setFigures(figures);
}

/** Whether the scene is embedded in the page. */
const isHeld = (): boolean => document.getElementById("scene-data") !== null;
/** Whether the server of the page shows a training. */
const isTraining = (): boolean => document.documentElement.dataset.training === "yes";

async function findPhotographs(panel: Panel): Promise<void> {
  if (isHeld() || isTraining()) return;
  const response = await fetch("photographs.json").catch(() => null);
  if (response?.ok !== true) return;
  const found: unknown = await response.json().catch(() => null);
  if (Array.isArray(found)) panel.setPhotographs(found.filter((x): x is number => Number.isInteger(x)));
}

function begin(): void {
  if (!hasPanel(location.hash)) {
    for (const id of ["panel", "hint"]) element(id, HTMLElement).hidden = true;
  }
  const viewer = new Viewer(element("view", HTMLCanvasElement));
  const panel = new Panel(viewer);
  viewer.onFail = (reason) => {
    showMessage(`Sorting failed in this browser: ${reason}`);
  };
  const show = async (): Promise<void> => {
    await load(viewer, panel, await openScene());
  };
  // A snapshot that fails is followed by others, and the last one by the end of the server.
  const showNext = (): Promise<void> => show().then(() => setText("message", ""), fail);
  const loaded = (isTraining() ? followTraining(showNext) : Promise.resolve(false)).then((isLive) =>
    isLive ? undefined : show(),
  );
  loaded.catch(fail);
  void findPhotographs(panel);
  window.a2tg = {
    loaded,
    viewer,
    render: (viewmat, K, size, mode) =>
      viewer.read(poseOf(viewmat, 1), lensOf(K, size), MODES.find((name) => name === mode) ?? "full"),
  };
  viewer.canvas.addEventListener("webglcontextlost", () => showMessage(CONTEXT_LOST));
}

function fail(error: unknown): void {
  showMessage(error instanceof SceneError ? error.message : `Something went wrong: ${String(error)}`);
}

try {
  begin();
} catch (error) {
  fail(error);
}
