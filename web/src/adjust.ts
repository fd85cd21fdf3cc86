/** The panel's sections that adjust what is shown: roll, lens and exposure; crop box, floaters and background. */

import type { Lens } from "./camera";
import { colorOf, hexOf } from "./edit";
import { WHOLE } from "./extent";
import type { Crop } from "./extent";
import type { Header } from "./format";
import type { Vec3 } from "./math";
import { element, setText } from "./page";
import { rollOf, rolled, verticalIn } from "./vertical";
import type { Viewer } from "./viewer";

const DEGREES = 180 / Math.PI;

/** Buttons and slider that turn the view upright, or call it so, and sliders of its lens and exposure. */
export class LevelControls {
  private readonly viewer: Viewer;
  private readonly roll = element("roll", HTMLInputElement);
  private readonly angle = element("angle", HTMLInputElement);
  private readonly exposure = element("exposure", HTMLInputElement);

  constructor(viewer: Viewer) {
    this.viewer = viewer;
    this.roll.addEventListener("input", () => this.turn(-Number(this.roll.value) / DEGREES));
    element("level", HTMLButtonElement).addEventListener("click", () => this.level());
    element("upright", HTMLButtonElement).addEventListener("click", () => this.callUpright());
    this.angle.addEventListener("input", () => this.widen(Number(this.angle.value) / DEGREES));
    this.exposure.addEventListener("input", () => {
      viewer.exposure = Number(this.exposure.value);
      viewer.onMove();
    });
  }

  /** Roll the view upright. */
  level(): void {
    this.turn(0);
  }

  /** Make the vertical what is up in this view, at the pitch that it has. */
  private callUpright(): void {
    const { viewer } = this;
    viewer.chooseUp(verticalIn(viewer.pose, viewer.up));
    viewer.onLeave();
  }

  private turn(roll: number): void {
    const { viewer } = this;
    viewer.pose = rolled(viewer.pose, viewer.up, roll);
    viewer.onMove();
  }

  /** Set the angle across the longer side of the image. */
  private widen(angle: number): void {
    const { viewer } = this;
    const factor = Math.tan(angleOf(viewer.image) / 2) / Math.tan(angle / 2);
    viewer.image = { ...viewer.image, fx: viewer.image.fx * factor, fy: viewer.image.fy * factor };
    viewer.onMove();
  }

  /** Show what the view has. */
  tell(): void {
    const { image, exposure } = this.viewer;
    element("angle-value", HTMLOutputElement).value = `${(angleOf(image) * DEGREES).toFixed(0)}°`;
    element("exposure-value", HTMLOutputElement).value = exposure.toFixed(1);
    if (!this.angle.matches(":active")) this.angle.value = String(angleOf(image) * DEGREES);
    if (!this.exposure.matches(":active")) this.exposure.value = String(exposure);
    if (!this.roll.matches(":active")) this.roll.value = String(-rollOf(this.viewer.pose, this.viewer.up) * DEGREES);
  }
}

const angleOf = ({ fx, fy, width, height }: Lens): number => 2 * Math.atan(Math.max(width / fx, height / fy) / 2);

/** Sliders of the crop box and of the floaters, the subject alone, and the background. */
export class CropControls {
  /** Handler called when the user has changed something. */
  onChange: () => void = () => undefined;
  private readonly viewer: Viewer;
  private readonly from = ["from-width", "from-depth", "from-height"].map((id) => element(id, HTMLInputElement));
  private readonly to = ["to-width", "to-depth", "to-height"].map((id) => element(id, HTMLInputElement));
  private readonly floaters = element("floaters", HTMLInputElement);
  private readonly ranges = ["width-range", "depth-range", "height-range"].map((id) => element(id, HTMLOutputElement));
  private readonly strictness = element("floaters-value", HTMLOutputElement);
  private readonly background = element("background", HTMLInputElement);
  private readonly alone = element("alone", HTMLButtonElement);

  constructor(viewer: Viewer) {
    this.viewer = viewer;
    this.tell();
    for (const slider of [...this.from, ...this.to, this.floaters]) {
      slider.addEventListener("input", () => this.apply());
    }
    element("uncrop", HTMLButtonElement).addEventListener("click", () => this.reset());
    this.alone.addEventListener("click", () => {
      viewer.isAlone = !viewer.isAlone;
      this.tell();
      this.changed();
    });
    this.background.addEventListener("input", () => {
      viewer.background = colorOf(this.background.value);
      this.changed();
    });
  }

  /** Show what a new scene has. */
  begin(header: Header): void {
    this.floaters.disabled = !header.hasFloaters;
    this.alone.disabled = !header.hasSubject;
    setText("subject", header.subject);
    this.show(header);
  }

  /** Set the sliders to what the viewer shows. */
  show(header: Header): void {
    const { crop, floaters, background } = this.viewer;
    for (const [k, slider] of this.from.entries()) slider.value = String(crop.from[k]);
    for (const [k, slider] of this.to.entries()) slider.value = String(crop.to[k]);
    this.floaters.value = String(floaters);
    this.background.value = hexOf(background ?? header.background);
    this.tell();
  }

  /** Crop to another box. */
  set(crop: Crop): void {
    this.viewer.crop = crop;
    if (this.viewer.splats !== null) this.show(this.viewer.splats.header);
    this.changed();
  }

  private reset(): void {
    const { viewer } = this;
    [viewer.crop, viewer.floaters, viewer.isAlone] = [WHOLE, 0, false];
    if (viewer.splats !== null) this.show(viewer.splats.header);
    this.changed();
  }

  private apply(): void {
    const { viewer } = this;
    viewer.crop = { from: valuesOf(this.from), to: valuesOf(this.to) };
    viewer.floaters = Number(this.floaters.value);
    this.tell();
    this.changed();
  }

  private changed(): void {
    this.viewer.draw();
    this.onChange();
  }

  /** Show the values of the sliders next to their names. */
  private tell(): void {
    for (const [k, output] of this.ranges.entries()) {
      output.value = `${percentOf(this.from[k])} to ${percentOf(this.to[k])} %`;
    }
    this.strictness.value = `${percentOf(this.floaters)} %`;
    this.alone.setAttribute("aria-pressed", String(this.viewer.isAlone));
  }
}

const percentOf = (slider?: HTMLInputElement): string => (100 * Number(slider?.value)).toFixed(0);

function valuesOf(sliders: readonly HTMLInputElement[]): Vec3 {
  const [x, y, z] = sliders.map((slider) => Number(slider.value));
  return [x ?? 0, y ?? 0, z ?? 0];
}
