// Poses of the nodes at any time, from the CUBICSPLINE keys of an animation.
import type { Animation, Glb } from "./glb.ts";
import { composed, IDENTITY, normalized, type Pose, type Quat, type Vec } from "./rigid.ts";

interface Curve { times: Float32Array; output: Float32Array; width: number }

function evaluate({ times, output, width }: Curve, t: number): number[] {
  const last = times.length - 1;
  const at = Math.min(Math.max(t, times[0]), times[last]);
  let low = 0, high = last - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] <= at) low = middle;
    else high = middle - 1;
  }
  const h = times[low + 1] - times[low], u = (at - times[low]) / h, u2 = u * u, u3 = u2 * u;
  const first = 2 * u3 - 3 * u2 + 1, leave = (u3 - 2 * u2 + u) * h, arrive = (u3 - u2) * h;
  const start = 3 * width * low, next = start + 3 * width;
  return Array.from({ length: width }, (_, k) =>
    first * output[start + width + k] + leave * output[start + 2 * width + k] +
    (1 - first) * output[next + width + k] + arrive * output[next + k]);
}

export class Motion {
  private readonly parents: number[];
  private readonly rest: Pose[];
  private curves = new Map<number, { translation?: Curve; rotation?: Curve }>();
  moves = false; // something changes over time

  constructor(private readonly glb: Glb) {
    const nodes = glb.tree.nodes;
    this.parents = nodes.map(() => -1);
    nodes.forEach((node, number) => node.children?.forEach((child) => { this.parents[child] = number; }));
    this.rest = nodes.map((node) => ({
      place: (node.translation ?? IDENTITY.place) as Vec, turn: (node.rotation ?? IDENTITY.turn) as Quat,
    }));
    this.use(glb.tree.animations?.[0]?.name ?? "");
  }

  // Play the animation of a mode.
  use(mode: string): void {
    this.curves = new Map();
    const animation: Animation | undefined = this.glb.tree.animations?.find((one) => one.name === mode);
    this.moves = animation !== undefined;
    for (const channel of animation?.channels ?? []) {
      if (channel.target.path === "scale") continue; // of absent objects, for other programs
      const sampler = animation!.samplers[channel.sampler];
      const found = this.curves.get(channel.target.node) ?? {};
      const path = channel.target.path as "translation" | "rotation";
      found[path] = {
        times: this.glb.array(sampler.input), output: this.glb.array(sampler.output), width: path === "rotation" ? 4 : 3,
      };
      this.curves.set(channel.target.node, found);
    }
  }

  // Pose in the frame of the parent.
  local(node: number, t: number): Pose {
    const found = this.curves.get(node), rest = this.rest[node];
    if (!found) return rest;
    return {
      place: found.translation ? evaluate(found.translation, t) as Vec : rest.place,
      turn: found.rotation ? normalized(evaluate(found.rotation, t) as Quat) : rest.turn,
    };
  }

  // Pose in the world of the data set: that of glTF without the turn of the root node.
  data(node: number, t: number): Pose {
    const parent = this.parents[node];
    return parent < 0 ? IDENTITY : composed(this.data(parent, t), this.local(node, t));
  }

  // Pose of the root node: from the data set's world to y up.
  get root(): Pose { return this.rest[this.glb.tree.scenes[0].nodes[0]]; }

  world(node: number, t: number): Pose { return composed(this.root, this.data(node, t)); }
}
