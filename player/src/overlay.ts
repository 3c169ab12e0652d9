// Path of an object and the tube of its confidence band, drawn over the picture.
import type { Band, Group, Model } from "./model.ts";
import type { Eye, Lens } from "./pick.ts";
import type { Vec } from "./rigid.ts";
import { projected } from "./views.ts";

const STEPS = 120;

export function widthAt(band: Band, t: number): number {
  const { times, half_width: widths } = band, last = times.length - 1;
  if (t <= times[0]) return widths[0];
  for (let k = 0; k < last; k++) {
    if (t <= times[k + 1]) return widths[k] + ((widths[k + 1] - widths[k]) * (t - times[k])) / (times[k + 1] - times[k]);
  }
  if (last === 0) return widths[0];
  const slope = (widths[last] - widths[last - 1]) / (times[last] - times[last - 1]);
  return widths[last] + Math.max(slope, 0) * (t - times[last]);
}

export class Overlay {
  private readonly context: CanvasRenderingContext2D;

  constructor(private readonly canvas: HTMLCanvasElement, private readonly model: Model) {
    this.context = canvas.getContext("2d")!;
  }

  resize(width: number, height: number, ratio: number): void {
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
  }

  // Draw for a group while it is in the scene, or clear if there is none. Lens and sizes are in CSS pixels.
  draw(group: Group | undefined, eye: Eye, lens: Lens, past: string, future: string): void {
    const { context: c, model } = this;
    c.clearRect(0, 0, lens.width, lens.height);
    if (!group || group.node < 0 || !model.motion.moves) return;
    const place = (t: number): Vec | null => model.isThere(group, t) ? model.motion.world(group.node, model.clock(t)).place : null;
    if (group.band && model.end > model.tMax) {
      c.fillStyle = future;
      c.globalAlpha = 0.3;
      c.beginPath(); // one shape, so that overlapping discs do not add up
      for (let k = 0; k <= STEPS; k++) {
        const t = model.tMax + ((model.end - model.tMax) * k) / STEPS, center = place(t);
        const at = center && projected(eye, lens, center);
        if (!at) continue;
        const radius = (lens.fx * widthAt(group.band, t)) / at[2];
        c.moveTo(at[0] + radius, at[1]);
        c.arc(at[0], at[1], radius, 0, 2 * Math.PI);
      }
      c.fill();
      c.globalAlpha = 1;
    }
    this.line(past, model.start, model.tMax, place, eye, lens, []);
    this.line(future, model.tMax, model.end, place, eye, lens, [6, 4]);
  }

  private line(color: string, from: number, to: number, place: (t: number) => Vec | null, eye: Eye, lens: Lens, dash: number[]): void {
    if (!(to > from)) return;
    const c = this.context;
    c.strokeStyle = color;
    c.lineWidth = 2.5;
    c.setLineDash(dash);
    c.beginPath();
    for (let k = 0, pen = false; k <= STEPS; k++) {
      const center = place(from + ((to - from) * k) / STEPS), at = center && projected(eye, lens, center);
      if (!at) pen = false;
      else if (pen) c.lineTo(at[0], at[1]);
      else { c.moveTo(at[0], at[1]); pen = true; }
    }
    c.stroke();
    c.setLineDash([]);
  }
}
