// Cameras: orbit around a point, free flight, and the captured ones.
import type { Camera, Model } from "./model.ts";
import type { Eye, Lens } from "./pick.ts";
import { add, cross, fromAxes, length, rotate, scaled, sub, unit, type Vec } from "./rigid.ts";

const UP: Vec = [0, 1, 0];
const FIELD = 0.8; // field of view of the shorter side, rad
const STEEPEST = 1.55; // rad

export class Views {
  captured: Camera | null = null;
  flying = false;
  private target: Vec;
  private distance: number;
  private yaw = 0.6;
  private pitch = 0.35;

  constructor(private readonly model: Model) {
    this.target = model.center;
    this.distance = 1.3 * model.extent;
    if (model.cameras.length) this.startFrom(model.cameras[0]);
  }

  // Orbit from where a captured camera stands, around the point before it that is nearest to the scene's centre.
  startFrom(camera: Camera): void {
    const { place, turn } = this.model.motion.world(camera.node, 0);
    const ahead = rotate(turn, [0, 0, -1]), to = sub(this.model.center, place);
    const reach = Math.max(0.1 * this.model.extent, to[0] * ahead[0] + to[1] * ahead[1] + to[2] * ahead[2]);
    this.target = add(place, scaled(ahead, reach));
    this.distance = reach;
    this.yaw = Math.atan2(-ahead[0], -ahead[2]);
    this.pitch = Math.asin(Math.min(1, Math.max(-1, -ahead[1])));
    this.captured = null;
  }

  choose(camera: Camera | null): void {
    if (camera) this.startFrom(camera);
    this.captured = camera;
  }

  private get back(): Vec {
    const c = Math.cos(this.pitch);
    return [c * Math.sin(this.yaw), Math.sin(this.pitch), c * Math.cos(this.yaw)];
  }

  eye(): Eye {
    if (this.captured) return this.model.motion.world(this.captured.node, 0);
    const back = this.back, right = unit(cross(UP, back));
    return { place: add(this.target, scaled(back, this.distance)), turn: fromAxes(right, cross(back, right), back) };
  }

  // Lens for a picture of a given size; a captured camera is shown as a whole.
  lens(width: number, height: number): Lens {
    if (this.captured) {
      const { intrinsics: k, width: w, height: h } = this.captured;
      const scale = Math.min(width / w, height / h), left = (width - scale * w) / 2, top = (height - scale * h) / 2;
      return {
        fx: scale * k[0][0], fy: scale * k[1][1], cx: scale * k[0][2] + left, cy: scale * k[1][2] + top, width, height,
      };
    }
    const focal = (0.5 * Math.min(width, height)) / Math.tan(0.5 * FIELD);
    return { fx: focal, fy: focal, cx: width / 2, cy: height / 2, width, height };
  }

  turn(dx: number, dy: number): void {
    this.captured = null;
    const place = this.eye().place;
    this.yaw -= dx;
    this.pitch = Math.min(STEEPEST, Math.max(-STEEPEST, this.pitch + dy));
    if (this.flying) this.target = sub(place, scaled(this.back, this.distance));
  }

  // Shift the point of view sideways and up, as shares of the distance.
  pan(dx: number, dy: number): void {
    this.captured = null;
    const { turn } = this.eye(), step = this.distance;
    this.target = add(this.target, rotate(turn, [-dx * step, dy * step, 0]));
  }

  zoom(factor: number): void {
    this.captured = null;
    if (this.flying) this.fly(0, 0, 0.3 * Math.log(1 / factor));
    else this.distance = Math.min(20 * this.model.extent, Math.max(2 * this.model.near, this.distance * factor));
  }

  // Move along the axes of the camera, as shares of the scene's extent.
  fly(right: number, up: number, ahead: number): void {
    this.captured = null;
    const step = scaled([right, up, -ahead], this.model.extent);
    this.target = add(this.target, rotate(this.eye().turn, step));
  }

  lookAt(point: Vec, size: number): void {
    this.captured = null;
    this.target = point;
    this.distance = Math.max(length(size > 0 ? [size, size, size] : [0, 0, 0]) * 2, 4 * this.model.near);
  }
}

// Pixel of a point, or null behind the camera.
export function projected(eye: Eye, lens: Lens, point: Vec): [number, number, number] | null {
  const back = rotate([-eye.turn[0], -eye.turn[1], -eye.turn[2], eye.turn[3]], sub(point, eye.place));
  if (!(back[2] < 0)) return null;
  return [lens.cx - (lens.fx * back[0]) / back[2], lens.cy + (lens.fy * back[1]) / back[2], -back[2]];
}
