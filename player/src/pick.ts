// The object at a pixel by the rule of the rasterizer: the one with the largest sum of weights, if alpha reaches one half.
import type { Model, Piece } from "./model.ts";
import { multiply, type Quat, rows, type Vec } from "./rigid.ts";

export interface Lens { fx: number; fy: number; cx: number; cy: number; width: number; height: number }
export interface Eye { turn: Quat; place: Vec } // camera to world, looking along -z

const DILATION = 0.3, ALPHA_MIN = 1 / 255, ALPHA_MAX = 0.99, SLACK = 1.3, FINISHED = 1e-4 * (1 + 1e-6);

interface Hit { depth: number; alpha: number; object: number }

// Id of the object, or null for none. Pixel coordinates from the upper left corner; pixel centres are at + 0.5.
export function pick(model: Model, t: number, eye: Eye, lens: Lens, x: number, y: number, hidden: Set<Piece>): number | null {
  const shown = model.pieces.filter((piece) => !hidden.has(piece) && model.isThere(piece.group, t));
  const hits = shown.flatMap((piece) => hitsOf(model, piece, t, eye, lens, x, y));
  hits.sort((a, b) => a.depth - b.depth);
  const votes = new Map<number, number>();
  let passed = 1;
  for (const { alpha, object } of hits) {
    if (passed * (1 - alpha) < FINISHED) break;
    votes.set(object, (votes.get(object) ?? 0) + alpha * passed);
    passed *= 1 - alpha;
  }
  if (1 - passed < 0.5) return null;
  return [...votes].sort((a, b) => b[1] - a[1] || a[0] - b[0])[0][0];
}

function hitsOf(model: Model, piece: Piece, t: number, eye: Eye, lens: Lens, x: number, y: number): Hit[] {
  const pose = model.worldPose(piece, t), back: Quat = [-eye.turn[0], -eye.turn[1], -eye.turn[2], eye.turn[3]];
  const turn = multiply(back, pose.turn), [rx, ry, rz] = rows(turn), [ex, ey, ez] = rows(back);
  const far = [0, 1, 2].map((k) => pose.place[k] - eye.place[k]);
  const sx = ex[0] * far[0] + ex[1] * far[1] + ex[2] * far[2];
  const sy = ey[0] * far[0] + ey[1] * far[1] + ey[2] * far[2];
  const sz = ez[0] * far[0] + ez[1] * far[1] + ez[2] * far[2];
  const { positions: p, scales, quats, opacities } = piece, hits: Hit[] = [];
  const [left, right] = [-lens.cx / lens.fx, (lens.width - lens.cx) / lens.fx];
  const [top, bottom] = [-lens.cy / lens.fy, (lens.height - lens.cy) / lens.fy];
  const [slackU, slackV] = [(SLACK - 1) * 0.5 * (right - left), (SLACK - 1) * 0.5 * (bottom - top)];
  for (let i = 0; i < piece.count; i++) {
    const a = p[3 * i], b = p[3 * i + 1], c = p[3 * i + 2];
    const z = -(rz[0] * a + rz[1] * b + rz[2] * c + sz); // OpenCV axes: y down, z forward
    if (!(z > model.near) || opacities[i] < ALPHA_MIN) continue;
    const px = rx[0] * a + rx[1] * b + rx[2] * c + sx, py = -(ry[0] * a + ry[1] * b + ry[2] * c + sy);
    const dx = x - (lens.fx * px / z + lens.cx), dy = y - (lens.fy * py / z + lens.cy);
    const largest = Math.max(scales[3 * i], scales[3 * i + 1], scales[3 * i + 2]);
    const reach = 3.4 * (lens.fx + lens.fy) * largest * 2 / z + 3;
    if (dx * dx + dy * dy > reach * reach) continue;
    const u = Math.min(Math.max(px / z, left - slackU), right + slackU);
    const v = Math.min(Math.max(py / z, top - slackV), bottom + slackV);
    const axes = rows(multiply(turn, [quats[4 * i], quats[4 * i + 1], quats[4 * i + 2], quats[4 * i + 3]]));
    let square = DILATION * (dx * dx + dy * dy), norm = 0;
    const ax: number[] = [], ay: number[] = [];
    for (let k = 0; k < 3; k++) {
      const s = scales[3 * i + k], down = -axes[1][k] * s, ahead = -axes[2][k] * s;
      ax.push((lens.fx / z) * (axes[0][k] * s - u * ahead));
      ay.push((lens.fy / z) * (down - v * ahead));
      square += (dx * ay[k] - dy * ax[k]) ** 2;
      norm += ax[k] ** 2 + ay[k] ** 2;
    }
    const area = (ax[0] * ay[1] - ax[1] * ay[0]) ** 2 + (ax[0] * ay[2] - ax[2] * ay[0]) ** 2
      + (ax[1] * ay[2] - ax[2] * ay[1]) ** 2;
    const alpha = Math.min(ALPHA_MAX, opacities[i] * Math.exp(-0.5 * square / (area + DILATION * (norm + DILATION))));
    if (alpha >= ALPHA_MIN) hits.push({ depth: z, alpha, object: piece.object });
  }
  return hits;
}
