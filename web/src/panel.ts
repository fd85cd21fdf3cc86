/** The side panel: display mode, cameras and their photographs, link, path. */

import { CropControls, LevelControls } from "./adjust";
import { BoxHandles } from "./box";
import { intrinsicsOf, viewmatOf } from "./camera";
import type { Intrinsics, Viewmat } from "./camera";
import { textOfEdit } from "./edit";
import type { Crop } from "./extent";
import { Flight } from "./flight";
import type { Header } from "./format";
import { History } from "./history";
import { hasPanel, linkOf, viewOf } from "./link";
import type { Vec2, Vec3 } from "./math";
import { element, setText } from "./page";
import { MODES } from "./shaders";
import type { Mode } from "./shaders";
import type { Viewer } from "./viewer";

const LEGENDS: Partial<Record<Mode, string>> = {
  texture: "Colour added by textures. Grey means none.",
  resolution: "Square textures are blue, others red. More texels give a deeper colour. Dark means one texel or none.",
  depth: "Bright is near, dark is far.",
  normals: "Red, green and blue show x, y and z of the normal.",
  ellipses: "Each Gaussian is drawn out to 1.4 standard deviations.",
};

/** View in a path file, in the format of a2tg render --path. */
interface KeptView {
  readonly viewmat: Viewmat;
  readonly K: Intrinsics;
  readonly size: Vec2;
}

/** What "Save edit" saves, and can be taken back. */
interface EditState {
  readonly crop: Crop;
  readonly floaters: number;
  readonly isAlone: boolean;
  readonly up: Vec3 | null;
  readonly background: Vec3 | null;
}

export class Panel {
  private readonly viewer: Viewer;
  private readonly mode = element("mode", HTMLSelectElement);
  private readonly camera = element("camera", HTMLSelectElement);
  private readonly divide = element("divide", HTMLInputElement);
  private readonly divider = element("divider", HTMLInputElement);
  private readonly wipe = element("wipe", HTMLInputElement);
  private readonly photograph = element("photograph", HTMLImageElement);
  private photographs: ReadonlySet<number> = new Set();
  private header: Header | null = null;
  private current: number | null = null;
  private kept: KeptView[] = [];
  private linkTimer = 0;
  private readonly isShown = hasPanel(location.hash);
  private readonly leveling: LevelControls;
  private readonly cropping: CropControls;
  private readonly flight: Flight;
  private history: History<EditState>;

  constructor(viewer: Viewer) {
    this.viewer = viewer;
    this.mode.addEventListener("change", () => this.setMode(MODES.find((mode) => mode === this.mode.value) ?? "full"));
    this.divide.addEventListener("change", () => this.setDivided());
    this.divider.addEventListener("input", () => this.setDivided());
    this.camera.addEventListener("change", () => this.goTo(Number(this.camera.value)));
    this.wipe.addEventListener("input", () => this.placePhotograph());
    this.onClick("before", () => this.step(-1));
    this.onClick("after", () => this.step(1));
    this.onClick("start", () => this.restart());
    this.onClick("link", () => {
      void this.copyLink();
    });
    this.onClick("fullscreen", () => {
      void toggleFullScreen();
    });
    // Phones and frames may have none.
    element("fullscreen", HTMLButtonElement).hidden = !document.fullscreenEnabled;
    this.onClick("keep", () => this.keep());
    this.onClick("save", () => this.save());
    this.onClick("save-edit", () => this.saveEdit());
    this.leveling = new LevelControls(viewer);
    this.cropping = new CropControls(viewer);
    this.cropping.onChange = () => this.noteLink();
    const box = new BoxHandles(viewer);
    box.onCrop = (crop) => this.cropping.set(crop);
    viewer.onFrame = () => {
      this.leveling.tell();
      box.place();
    };
    this.history = new History(this.state);
    this.onClick("undo", () => this.restore(this.history.undo()));
    this.onClick("redo", () => this.restore(this.history.redo()));
    // A drag of a slider is one change, at its end.
    for (const kind of ["change", "click", "pointerup", "keyup"]) addEventListener(kind, () => this.remember());
    this.flight = new Flight(viewer);
    this.flight.onChange = () => this.leave();
    viewer.onLeave = () => this.leave();
    addEventListener("keydown", (event) => this.pressKey(event));
    addEventListener("resize", () => this.placePhotograph());
    addEventListener("hashchange", () => this.followLink());
    if (matchMedia("(max-width: 600px)").matches) element("panel", HTMLDetailsElement).open = false;
  }

  /** Show the title, cameras and modes of a new scene. */
  begin(header: Header): void {
    this.header = header;
    const title = header.title === "" ? "a2tg view" : header.title;
    element("title", HTMLElement).textContent = title;
    document.title = `${title} · a2tg view`;
    setText("note", header.note);
    element("cameras", HTMLElement).hidden = header.cameras.length === 0;
    this.cropping.begin(header);
    this.flight.begin(header.cameras);
    const choices = header.cameras.map(
      (camera, index) => new Option(camera.isTest ? `${camera.name} (test)` : camera.name, String(index)),
    );
    this.camera.replaceChildren(new Option("free", "-1"), ...choices);
    this.offerModes(header);
  }

  /** Offer the modes that a scene has: a training may add textures. */
  offerModes(header: Header): void {
    const hasTextures = header.numTexels > 0;
    element("compare", HTMLElement).hidden = !hasTextures;
    for (const option of this.mode.options) {
      option.disabled = !hasTextures && ["plain", "texture", "resolution"].includes(option.value);
    }
  }

  /** Go to the view in the address, or to the camera that shows the front. */
  ready(): void {
    if (!this.followLink()) this.restart();
    this.history = new History(this.state);
    this.remember();
  }

  /** Set which cameras have a photograph next to the page. */
  setPhotographs(indices: readonly number[]): void {
    this.photographs = new Set(indices);
    this.showPhotograph();
  }

  private onClick(id: string, act: () => void): void {
    element(id, HTMLButtonElement).addEventListener("click", act);
  }

  private restart(): void {
    const { splats } = this.viewer;
    if (splats === null) return;
    this.flight.stop();
    this.viewer.settle(splats);
    this.tellEdit();
    this.setCurrent(splats.header.cameras.length > 0 ? splats.header.first : null);
    this.viewer.draw();
  }

  private setMode(mode: Mode): void {
    // A key or a link may name a mode that the scene lacks.
    if (Array.from(this.mode.options).some((option) => option.value === mode && option.disabled)) return;
    this.viewer.mode = mode;
    this.mode.value = mode;
    setText("legend", LEGENDS[mode] ?? "");
    this.viewer.draw();
    this.noteLink();
  }

  private setDivided(): void {
    this.divider.hidden = !this.divide.checked;
    this.viewer.divided = this.divide.checked ? Number(this.divider.value) : null;
    this.viewer.draw();
  }

  private goTo(index: number): void {
    const camera = this.header?.cameras.at(index);
    if (index < 0 || camera === undefined) return;
    this.flight.stop();
    this.viewer.goTo(camera);
    this.setCurrent(index);
    this.noteLink();
  }

  private step(by: number): void {
    const num = this.header?.cameras.length ?? 0;
    if (num === 0) return;
    const from = this.current ?? (by > 0 ? -1 : 0);
    this.goTo((from + by + num) % num);
  }

  private leave(): void {
    element("hint", HTMLElement).hidden = true;
    if (this.current !== null) this.setCurrent(null);
    this.noteLink();
  }

  private setCurrent(index: number | null): void {
    this.current = index;
    this.camera.value = String(index ?? -1);
    this.showPhotograph();
  }

  private showPhotograph(): void {
    const index = this.current;
    const isThere = index !== null && this.photographs.has(index);
    element("photo", HTMLElement).hidden = !isThere;
    this.photograph.hidden = !isThere;
    if (isThere) {
      this.photograph.src = `photographs/${index}.jpg`;
      this.photograph.alt = `Photograph ${this.header?.cameras[index]?.name ?? ""}`;
      this.placePhotograph();
    }
  }

  /** Align the photograph with the camera's image and clip it at the slider's share of the width. */
  private placePhotograph(): void {
    const { image, lens } = this.viewer;
    const s = lens.fx / image.fx;
    const share = Number(this.wipe.value);
    const { style } = this.photograph;
    style.left = `${(lens.width - image.width * s) / 2}px`;
    style.top = `${(lens.height - image.height * s) / 2}px`;
    style.width = `${image.width * s}px`;
    style.height = `${image.height * s}px`;
    style.clipPath = `inset(0 ${100 * (1 - share)}% 0 0)`;
    style.visibility = share > 0 ? "visible" : "hidden";
  }

  private noteLink(): void {
    this.tellEdit();
    clearTimeout(this.linkTimer);
    this.linkTimer = window.setTimeout(() => {
      // Some browsers forbid changing the address of a page opened from disk.
      try {
        history.replaceState(null, "", this.link);
      } catch {
        /* then it stays */
      }
    }, 400);
  }

  private get link(): string {
    const { pose, image, mode, fit, exposure } = this.viewer;
    const { isOn: isFlying } = this.flight;
    return linkOf({ pose, lens: image, mode, fit, ...this.state, exposure, isFlying, hasPanel: this.isShown });
  }

  private async copyLink(): Promise<void> {
    const address = new URL(this.link, location.href).href;
    const button = element("link", HTMLButtonElement);
    try {
      await navigator.clipboard.writeText(address);
      button.textContent = "Copied";
    } catch {
      location.hash = this.link;
      button.textContent = "See address bar";
    }
    window.setTimeout(() => {
      button.textContent = "Copy link";
    }, 1500);
  }

  private followLink(): boolean {
    const view = viewOf(location.hash);
    if (view === null) return false;
    const { viewer } = this;
    this.flight.stop();
    if (viewer.splats !== null) viewer.settle(viewer.splats);
    [viewer.pose, viewer.image, viewer.fit] = [view.pose, view.lens, view.fit];
    if (view.up !== null) viewer.chooseUp(view.up);
    [viewer.crop, viewer.floaters, viewer.background] = [view.crop, view.floaters, view.background];
    viewer.isAlone = view.isAlone;
    viewer.exposure = view.exposure;
    if (this.header !== null) this.cropping.show(this.header);
    this.setMode(view.mode);
    this.setCurrent(null);
    viewer.draw();
    if (view.isFlying && !matchMedia("(prefers-reduced-motion: reduce)").matches) this.flight.start();
    return true;
  }

  private keep(): void {
    const { pose, image } = this.viewer;
    this.kept.push({ viewmat: viewmatOf(pose), K: intrinsicsOf(image), size: [image.width, image.height] });
    this.tellKept();
  }

  private save(): void {
    download(JSON.stringify({ format: "a2tg-jax path", version: 1, views: this.kept }, null, 1), "path.json");
    this.kept = [];
    this.tellKept();
  }

  private get state(): EditState {
    const { crop, floaters, isAlone, up, isUpChosen, background } = this.viewer;
    return { crop, floaters, isAlone, up: isUpChosen ? up : null, background };
  }

  private remember(): void {
    this.history.add(this.state);
    element("undo", HTMLButtonElement).disabled = !this.history.canUndo;
    element("redo", HTMLButtonElement).disabled = !this.history.canRedo;
  }

  private restore(state: EditState | null): void {
    if (state === null || this.header === null) return;
    const { viewer } = this;
    [viewer.crop, viewer.floaters, viewer.isAlone] = [state.crop, state.floaters, state.isAlone];
    viewer.background = state.background;
    viewer.chooseUp(state.up);
    this.cropping.show(this.header);
    this.remember();
    this.noteLink();
  }

  /** Text of what was changed; null if nothing was. */
  private get edit(): string | null {
    return textOfEdit({ clip: this.viewer.clip, ...this.state });
  }

  private tellEdit(): void {
    element("save-edit", HTMLButtonElement).disabled = this.edit === null;
  }

  private saveEdit(): void {
    const text = this.edit;
    if (text !== null) download(text, "edit.json");
  }

  private tellKept(): void {
    element("kept", HTMLElement).textContent = String(this.kept.length);
    element("save", HTMLButtonElement).disabled = this.kept.length === 0;
  }

  private pressKey(event: KeyboardEvent): void {
    const key = event.key.toLowerCase();
    if ((event.ctrlKey || event.metaKey) && !event.altKey && (key === "z" || key === "y")) {
      event.preventDefault();
      const isBack = key === "z" && !event.shiftKey;
      this.restore(isBack ? this.history.undo() : this.history.redo());
    }
    if (event.altKey || event.metaKey || event.ctrlKey) return;
    if (event.target instanceof HTMLSelectElement || event.target instanceof HTMLInputElement) return;
    const mode = MODES.at(Number(event.key) - 1);
    if (/^[1-7]$/.test(event.key) && mode !== undefined) this.setMode(mode);
    else if (event.key === ",") this.step(-1);
    else if (event.key === ".") this.step(1);
    else if (event.key.toLowerCase() === "l") this.leveling.level();
    else if (event.key.toLowerCase() === "h") {
      const panel = element("panel", HTMLDetailsElement);
      panel.open = !panel.open;
    }
  }
}

function download(text: string, name: string): void {
  const anchor = document.createElement("a");
  anchor.href = URL.createObjectURL(new Blob([text], { type: "application/json" }));
  anchor.download = name;
  anchor.click();
  URL.revokeObjectURL(anchor.href);
}

async function toggleFullScreen(): Promise<void> {
  if (document.fullscreenElement !== null) await document.exitFullscreen();
  else await document.documentElement.requestFullscreen();
}
