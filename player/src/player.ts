// State of the player: time, picked and hidden objects, camera.
import type { Engine } from "./engine.ts";
import type { Model, Piece } from "./model.ts";
import { Overlay } from "./overlay.ts";
import { pick } from "./pick.ts";
import { Controls, element } from "./ui.ts";
import { Views } from "./views.ts";

const TINT = 0.35;

export class Player {
  t: number;
  playing = false;
  loop = true;
  speed = 1;
  chosen: number | null = null;
  isolated: number | null = null;
  readonly views: Views;
  readonly controls: Controls;
  private readonly overlay: Overlay;
  private readonly hidden = new Set<number>();
  private hiddenPieces = new Set<Piece>();
  private last = 0;

  constructor(readonly model: Model, readonly engine: Engine, labels: { id: number; name: string; aliases: string[] }[]) {
    this.t = model.start;
    this.views = new Views(model);
    this.overlay = new Overlay(element<HTMLCanvasElement>("overlay"), model);
    this.controls = new Controls(this, labels);
    new ResizeObserver(() => this.resize()).observe(engine.canvas);
    this.followRatio();
    this.look();
    this.go(this.t);
  }

  // Go to a scene time; times outside the file become its first or last.
  go(t: number): void {
    this.t = Math.min(Math.max(t, this.model.start), this.model.end);
    this.engine.pose(this.t);
    this.controls.show();
  }

  play(on: boolean): void {
    if (on === this.playing) return;
    this.playing = on && this.model.motion.moves;
    if (this.playing) {
      if (this.t >= this.model.end) this.t = this.model.start;
      this.last = performance.now();
      requestAnimationFrame((now) => this.advance(now));
    }
    this.controls.show();
  }

  private advance(now: number): void {
    if (!this.playing) return;
    const passed = ((now - this.last) / 1000) * this.speed * this.model.unitsPerSecond;
    this.last = now;
    let t = this.t + Math.max(passed, 0);
    if (t > this.model.end) {
      if (this.loop) t = this.model.start;
      else this.playing = false;
    }
    this.go(t);
    if (this.playing) requestAnimationFrame((later) => this.advance(later));
  }

  setMode(mode: string): void {
    this.model.motion.use(mode);
    this.go(this.t);
    this.moved();
  }

  choose(id: number | null): void {
    this.chosen = id !== null && this.model.object(id) ? id : null;
    this.look();
  }

  isolate(id: number | null): void {
    this.isolated = id;
    this.look();
  }

  visible(id: number): boolean { return this.isolated === null ? !this.hidden.has(id) : this.isolated === id; }

  setVisible(id: number, on: boolean): void {
    if (this.isolated !== null) this.isolated = null;
    if (on) this.hidden.delete(id);
    else this.hidden.add(id);
    this.look();
  }

  private look(): void {
    const { model } = this;
    this.hiddenPieces = new Set(model.objects.filter((item) => !this.visible(item.id)).flatMap((item) => model.piecesOf(item.id)));
    if (this.isolated !== null) {
      const own = new Set(model.pieces.filter((one) => one.object === this.isolated));
      this.hiddenPieces = new Set(model.pieces.filter((one) => !own.has(one)));
    }
    const color = this.chosen === null ? undefined : model.object(this.chosen)?.color;
    const picked = model.pieces.filter((one) => one.object === this.chosen && color && this.chosen! > 0);
    this.engine.look(new Map(picked.map((one) => [one, [...color!, TINT]])), this.hiddenPieces);
    this.controls.marks();
    this.moved();
  }

  // Object at a point of the picture in CSS pixels, or null.
  pick(x: number, y: number): number | null {
    const { width, height } = this.size, { ratio } = this.engine;
    const lens = this.views.lens(ratio * width, ratio * height); // of the drawn pixels
    const [column, row] = [Math.floor(ratio * x) + 0.5, Math.floor(ratio * y) + 0.5];
    const found = pick(this.model, this.t, this.views.eye(), lens, column, row, this.hiddenPieces);
    return found !== null && found >= 0 ? found : null;
  }

  setCamera(value: string): void {
    this.views.flying = value === "fly";
    this.views.choose(this.model.cameras[Number(value)] ?? null);
    this.moved();
  }

  nextCamera(): void {
    const { cameras } = this.model;
    if (!cameras.length) return;
    const now = this.views.captured ? cameras.indexOf(this.views.captured) : -1;
    this.setCamera(String((now + 1) % cameras.length));
  }

  focus(id: number): void {
    const body = this.model.bodyOf(id);
    if (!body) return;
    const sizes = this.model.pieces.filter((one) => one.object === id).map((one) => Math.max(...one.positions.map(Math.abs)));
    this.views.lookAt(this.model.motion.world(body.node, this.model.clock(this.t)).place, Math.max(...sizes, 0));
    this.moved();
  }

  private get size(): { width: number; height: number } {
    const { clientWidth, clientHeight } = this.engine.canvas;
    return { width: Math.max(clientWidth, 1), height: Math.max(clientHeight, 1) };
  }

  // Show the view after the camera, the size or the picked object changed.
  moved(): void {
    const { width, height } = this.size, eye = this.views.eye(), lens = this.views.lens(width, height);
    this.engine.view(eye, lens);
    const group = this.chosen === null ? undefined : this.model.bodyOf(this.chosen);
    const style = getComputedStyle(document.documentElement);
    this.overlay.draw(group, eye, lens, style.getPropertyValue("--past"), style.getPropertyValue("--future"));
    const captured = this.views.captured;
    this.controls.cameraName(captured ? String(this.model.cameras.indexOf(captured)) : this.views.flying ? "fly" : "orbit");
  }

  // Resize now, and again each time the device's pixels change, as on another screen.
  private followRatio(): void {
    this.resize();
    matchMedia(`(resolution: ${devicePixelRatio}dppx)`).addEventListener("change", () => this.followRatio(), { once: true });
  }

  private resize(): void {
    const { width, height } = this.size;
    this.overlay.resize(width, height, devicePixelRatio || 1);
    this.engine.resize();
    this.moved();
  }
}
