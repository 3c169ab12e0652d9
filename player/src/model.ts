// Content of a scene: objects, motion groups, pieces of Gaussians and cameras.
import { Glb } from "./glb.ts";
import { Motion } from "./motion.ts";
import { dot, moved, type Pose, type Vec } from "./rigid.ts";

const EXTENSION = "KHR_gaussian_splatting";
const OWN = "_R5DGS_SH_";
const C0 = 0.28209479177387814;
const FRAMES_PER_SECOND = 24; // of a scene whose unit of time is unknown, as in Blender

export interface SceneObject {
  id: number;
  name: string;
  aliases: string[];
  caption: string;
  color: Vec;
  motion: string;
  prediction: { warning: string | null; half_width: number | null; half_width_percent: number | null };
}

export interface Band { times: number[]; half_width: number[]; level: number; predictable_until: number | null }

export interface Group {
  id: number;
  object_id: number;
  role: string;
  pivot: Vec;
  band?: Band;
  events?: { time: number; kind: string }[];
  joint?: { kind: string };
  absent?: [number | null, number | null][]; // scene times; null without end
  node: number;
}

export interface Piece {
  node: number; // node of the group
  group: Group;
  object: number;
  count: number;
  positions: Float32Array;
  quats: Float32Array;
  scales: Float32Array;
  opacities: Float32Array;
  harmonics: Float32Array[];
  shading: Float32Array | null; // vector and factor at t_max
}

export interface Camera { name: string; width: number; height: number; intrinsics: number[][]; node: number }

export class Model {
  readonly name: string;
  readonly objects: SceneObject[];
  readonly groups: Group[];
  readonly labels: { id: number; name: string; aliases: string[] }[]; // of all objects, also of those without Gaussians
  readonly pieces: Piece[];
  readonly cameras: Camera[];
  readonly motion: Motion;
  readonly start: number;
  readonly tMax: number;
  readonly end: number;
  readonly unitsPerSecond: number; // of scene time, at speed 1
  readonly frame: number; // in scene time
  private readonly pace: number; // seconds of an animation per unit of scene time
  readonly light: Vec | null;
  readonly near: number;
  readonly sky: Vec[];
  readonly modes: string[];
  readonly lost: string[];
  readonly words: [string, [number, number, number][]][];
  readonly center: Vec;
  readonly extent: number;

  constructor(data: ArrayBuffer) {
    const glb = new Glb(data), own = glb.tree.scenes[0].extras.r5dgs;
    this.motion = new Motion(glb);
    this.name = own.name;
    this.start = own.track_times[0];
    this.tMax = own.t_max;
    this.end = own.end;
    this.frame = 1 / own.frames_per_unit;
    this.pace = own.seconds_per_unit ?? 1;
    this.unitsPerSecond = own.seconds_per_unit ? 1 / own.seconds_per_unit : FRAMES_PER_SECOND * this.frame;
    this.light = own.light_direction;
    this.near = own.near_plane;
    this.sky = own.background_sh;
    this.modes = own.modes;
    this.lost = own.lost;
    this.words = own.words;
    const nodeOf = new Map<number, number>();
    glb.tree.nodes.forEach((node, number) => {
      const extras = node.extras?.r5dgs;
      if (extras?.group !== undefined && extras.object === undefined) nodeOf.set(extras.group, number);
    });
    this.groups = own.groups.map((group: Group) => ({ ...group, node: nodeOf.get(group.id) ?? -1 }));
    this.pieces = glb.tree.nodes.flatMap((node) => {
      const extras = node.extras?.r5dgs;
      if (node.mesh === undefined || extras?.object === undefined) return [];
      return [piece(glb, node.mesh, extras.object, this.groups[extras.group!], node.translation ?? [0, 0, 0])];
    });
    const present = new Set(this.pieces.map((one) => one.object));
    this.labels = own.objects;
    this.objects = own.objects.filter((item: SceneObject) => present.has(item.id));
    this.cameras = glb.tree.nodes.flatMap((node, number) => node.camera === undefined
      ? [] : [{ ...own.cameras[node.extras!.r5dgs!.camera!], node: number }]);
    [this.center, this.extent] = this.bounds();
  }

  object(id: number): SceneObject | undefined { return this.objects.find((item) => item.id === id); }

  // Pieces that disappear with an object: its Gaussians, and those of the background that move with it.
  piecesOf(id: number): Piece[] {
    return this.pieces.filter((one) => one.object === id
      || (one.object < 1 && one.group.role !== "pinned" && one.group.object_id === id));
  }

  // Node from which to show the path of an object: its largest body.
  bodyOf(id: number): Group | undefined {
    const sizes = new Map<Group, number>();
    for (const one of this.pieces) {
      if (one.object === id && one.group.object_id === id && one.group.role === "body") {
        sizes.set(one.group, (sizes.get(one.group) ?? 0) + one.count);
      }
    }
    return [...sizes].sort((a, b) => b[1] - a[1])[0]?.[0];
  }

  // Returns true if a group is in the scene at a scene time.
  isThere(group: Group, t: number): boolean {
    return !group.absent?.some(([first, last]) => (first ?? -Infinity) <= t && t < (last ?? Infinity));
  }

  // Time of the animations at a scene time.
  clock(t: number): number { return this.pace * (t - this.start); }

  worldPose(piece: Piece, t: number): Pose { return this.motion.world(piece.node, this.clock(t)); }

  // Centre and diagonal of the box of the middle 98 % of the centres at t_max, y up.
  private bounds(): [Vec, number] {
    const columns: number[][] = [[], [], []];
    for (const one of this.pieces) {
      const pose = this.worldPose(one, this.tMax), step = Math.max(1, Math.floor(one.count / 2000));
      for (let i = 0; i < one.count; i += step) {
        const p = moved(pose, [one.positions[3 * i], one.positions[3 * i + 1], one.positions[3 * i + 2]]);
        p.forEach((value, axis) => columns[axis].push(value));
      }
    }
    const ends = columns.map((values) => {
      values.sort((a, b) => a - b);
      return [values[Math.floor(0.01 * (values.length - 1))], values[Math.ceil(0.99 * (values.length - 1))]];
    });
    const sides = ends.map(([low, high]) => high - low) as Vec;
    return [ends.map(([low, high]) => (low + high) / 2) as Vec, Math.max(Math.sqrt(dot(sides, sides)), 1e-6)];
  }

  // Average colour of the sky.
  get skyColor(): Vec { return this.sky[0].map((dc) => Math.min(1, Math.max(0, 0.5 + C0 * dc))) as Vec; }
}

// Positions become those in the frame of the group's node.
function piece(glb: Glb, mesh: number, object: number, group: Group, place: number[]): Piece {
  const names = glb.tree.meshes[mesh].primitives[0].attributes;
  const column = (name: string) => glb.array(names[name]);
  const pairs = [0, 1, 2, 3].flatMap((degree) => Array.from({ length: 2 * degree + 1 }, (_, k) => [degree, k]));
  const standard = pairs.map(([degree, k]) => `${EXTENSION}:SH_DEGREE_${degree}_COEF_${k}`);
  const unshaded = pairs.map((_, k) => `${OWN}${k}`);
  const listed = names[unshaded[0]] === undefined ? standard : unshaded;
  const positions = column("POSITION").map((value, k) => value + place[k % 3]);
  return {
    node: group.node,
    group,
    object,
    count: positions.length / 3,
    positions,
    quats: column(`${EXTENSION}:ROTATION`),
    scales: column(`${EXTENSION}:SCALE`),
    opacities: column(`${EXTENSION}:OPACITY`),
    harmonics: listed.filter((name) => names[name] !== undefined).map(column),
    shading: names._R5DGS_SHADING === undefined ? null : column("_R5DGS_SHADING"),
  };
}
