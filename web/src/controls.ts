/** Camera control by mouse, touch and keyboard. */

import type { Lens, Pose } from "./camera";
import { dollied, moved, orbited, panned } from "./camera";
import { scale } from "./math";
import type { Vec2, Vec3 } from "./math";

/** State that the controls read and change. */
export interface Steered {
  pose: Pose;
  readonly up: Vec3;
  /** Size of the scene, which sets the flying speed and the smallest distance to the target. */
  readonly extent: number;
  /** Lens for the canvas, in CSS pixels. */
  readonly lens: Lens;
  onMove(): void;
  onAim(x: number, y: number): void;
}

const TURN = 1 / 250;
const FLIGHT: Readonly<Record<string, Vec3>> = {
  KeyW: [0, 0, 1],
  KeyS: [0, 0, -1],
  KeyA: [-1, 0, 0],
  KeyD: [1, 0, 0],
  KeyE: [0, -1, 0],
  KeyQ: [0, 1, 0],
};
const TURNS: Readonly<Record<string, Vec2>> = {
  ArrowLeft: [1, 0],
  ArrowRight: [-1, 0],
  ArrowUp: [0, 1],
  ArrowDown: [0, -1],
};

export class Controls {
  private readonly canvas: HTMLElement;
  private readonly steered: Steered;
  private readonly pointers = new Map<number, { x: number; y: number }>();
  private readonly keys = new Set<string>();
  private time = 0;
  private isFlying = false;
  /** Whether Shift is held. */
  private isFast = false;
  private tapped = { time: -Infinity, x: 0, y: 0 };

  constructor(canvas: HTMLElement, steered: Steered) {
    this.canvas = canvas;
    this.steered = steered;
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const kind of ["pointerup", "pointercancel"] as const) {
      canvas.addEventListener(kind, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("keydown", (event) => this.pressKey(event));
    canvas.addEventListener("keyup", (event) => {
      this.isFast = event.shiftKey;
      this.keys.delete(event.code);
    });
    canvas.addEventListener("blur", () => {
      this.keys.clear();
      canvas.classList.remove("is-pointed");
    });
  }

  private press(event: PointerEvent): void {
    // Browsers frame what a script focuses; the frame is for those who come by keyboard.
    this.canvas.classList.add("is-pointed");
    this.canvas.focus({ preventScroll: true });
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const { tapped } = this;
    const isNear = Math.hypot(event.clientX - tapped.x, event.clientY - tapped.y) < 20;
    if (this.pointers.size === 1 && isNear && event.timeStamp - tapped.time < 350) {
      const { left, top } = this.canvas.getBoundingClientRect();
      this.steered.onAim(event.clientX - left, event.clientY - top);
    }
    this.tapped = { time: event.timeStamp, x: event.clientX, y: event.clientY };
  }

  private drag(event: PointerEvent): void {
    const before = this.pointers.get(event.pointerId);
    if (before === undefined) return;
    const now = { x: event.clientX, y: event.clientY };
    const [dx, dy] = [now.x - before.x, now.y - before.y];
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
    this.pointers.set(event.pointerId, now);
    if (other !== undefined) {
      const span = (point: { x: number; y: number }): number => Math.hypot(point.x - other.x, point.y - other.y);
      this.zoom(span(before) / Math.max(span(now), 1));
      this.shift(dx / 2, dy / 2);
    } else if (event.buttons & 6 || event.shiftKey) {
      this.shift(dx, dy);
    } else if (event.ctrlKey) {
      this.change(panned(this.steered.pose, this.steered.up, dx * TURN, dy * TURN));
    } else {
      this.change(orbited(this.steered.pose, this.steered.up, -dx * TURN, -dy * TURN));
    }
  }

  private wheel(event: WheelEvent): void {
    // Within another page the wheel scrolls that page, until the scene is clicked.
    const isFramed = window.parent !== window;
    const isMeant = event.ctrlKey || event.metaKey || document.activeElement === this.canvas;
    if (isFramed && !isMeant) return;
    event.preventDefault();
    const lines = event.deltaMode === WheelEvent.DOM_DELTA_PIXEL ? event.deltaY / 40 : event.deltaY;
    this.zoom(Math.exp(Math.max(-3, Math.min(3, lines)) * 0.06));
  }

  private pressKey(event: KeyboardEvent): void {
    this.isFast = event.shiftKey;
    if (event.altKey || event.metaKey || event.ctrlKey) return;
    if (event.code in FLIGHT || event.code in TURNS) {
      event.preventDefault();
      this.keys.add(event.code);
      if (!this.isFlying) {
        this.isFlying = true;
        requestAnimationFrame((time) => {
          this.time = time;
          this.fly(time);
        });
      }
    } else if (event.key === "+" || event.key === "=") {
      this.zoom(1 / 1.1);
    } else if (event.key === "-") {
      this.zoom(1.1);
    }
  }

  private fly(time: number): void {
    const seconds = Math.min((time - this.time) / 1000, 0.1);
    this.time = time;
    if (this.keys.size === 0) {
      this.isFlying = false;
      return;
    }
    const speed = this.steered.extent * (this.isFast ? 1.5 : 0.5) * seconds;
    let { pose } = this.steered;
    for (const key of this.keys) {
      const [flight, turn] = [FLIGHT[key], TURNS[key]];
      if (flight !== undefined) pose = moved(pose, scale(flight, speed));
      if (turn !== undefined) pose = panned(pose, this.steered.up, turn[0] * seconds, turn[1] * seconds);
    }
    this.change(pose);
    requestAnimationFrame((next) => this.fly(next));
  }

  private zoom(factor: number): void {
    this.change(dollied(this.steered.pose, factor, 1e-3 * this.steered.extent));
  }

  /** Move the camera so that the target follows the pointer. */
  private shift(dx: number, dy: number): void {
    const { pose, lens } = this.steered;
    this.change(moved(pose, [(-dx * pose.focus) / lens.fx, (-dy * pose.focus) / lens.fy, 0]));
  }

  private change(pose: Pose): void {
    this.steered.pose = pose;
    this.steered.onMove();
  }
}
