// Drawing with PlayCanvas: one entity per piece of Gaussians, moved, shaded and tinted at each time.
import * as pc from "playcanvas";
import * as kernel from "./kernel.ts";
import type { Model, Piece } from "./model.ts";
import type { Eye, Lens } from "./pick.ts";
import { conjugate, rotate, sub } from "./rigid.ts";
import { skyEntity } from "./sky.ts";

const STILL_FRAMES = 20; // frames without a change after which drawing stops
const MAX_RATIO = 2; // drawn pixels per CSS pixel
const SHADING = "shading";

interface Drawn { piece: Piece; entity: pc.Entity }

export class Engine {
  readonly app: pc.AppBase;
  private readonly eye: pc.Entity;
  private readonly room: pc.Entity; // parent of the eye, which VR moves in it
  private readonly drawn: Drawn[] = [];
  private still = 0;
  private time = 0;
  private hidden = new Set<Piece>();
  private viewer: Eye = { place: [0, 0, 0], turn: [0, 0, 0, 1] };
  private lens: Lens = { fx: 1, fy: 1, cx: 0.5, cy: 0.5, width: 1, height: 1 };
  private waiting: (() => void)[] = [];

  private constructor(readonly canvas: HTMLCanvasElement, readonly model: Model, device: pc.GraphicsDevice) {
    const options = new pc.AppOptions();
    options.graphicsDevice = device;
    options.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem, pc.RenderComponentSystem];
    options.resourceHandlers = [pc.TextureHandler, pc.GSplatHandler];
    options.xr = pc.XrManager;
    this.app = new pc.AppBase(canvas);
    this.app.init(options);
    this.app.setCanvasFillMode(pc.FILLMODE_NONE);
    this.app.setCanvasResolution(pc.RESOLUTION_AUTO);
    const params = this.app.scene.gsplat;
    params.dataFormat = pc.GSPLATDATA_LARGE;
    params.minPixelSize = 0;
    params.minContribution = 0;
    params.alphaClipForward = 1 / 255;
    kernel.install(device, params);
    [this.room, this.eye] = [new pc.Entity("room"), new pc.Entity("eye")];
    this.eye.addComponent("camera", {
      clearColor: new pc.Color(...model.skyColor), nearClip: model.near, farClip: 100 * model.extent,
      toneMapping: pc.TONEMAP_NONE,
    });
    this.eye.camera!.calculateProjection = (matrix) => this.project(matrix);
    this.app.root.addChild(this.room);
    this.room.addChild(this.eye);
    const sky = skyEntity(device, model);
    if (sky) this.app.root.addChild(sky);
    for (const piece of model.pieces) this.drawn.push({ piece, entity: this.add(piece) });
    this.app.autoRender = false;
    this.app.on("update", () => this.tick());
    this.app.xr!.on("start", () => this.enterRoom());
    this.app.xr!.on("end", () => this.leaveRoom());
    this.app.on("frameend", () => this.waiting.splice(0).forEach((done) => done()));
    this.app.start();
  }

  static async create(canvas: HTMLCanvasElement, model: Model): Promise<Engine> {
    const device = await pc.createGraphicsDevice(canvas, { deviceTypes: ["webgl2"], antialias: false });
    return new Engine(canvas, model, device);
  }

  private add(piece: Piece): pc.Entity {
    const column = (name: string, storage: Float32Array) => ({ type: "float", name, storage, byteSize: 4 });
    const split = (values: Float32Array, width: number, k: number) =>
      Float32Array.from({ length: piece.count }, (_, i) => values[width * i + k]);
    const properties = [
      ...["x", "y", "z"].map((name, k) => column(name, split(piece.positions, 3, k))),
      ...[3, 0, 1, 2].map((k, number) => column(`rot_${number}`, split(piece.quats, 4, k))),
      ...[0, 1, 2].map((k) => column(`scale_${k}`, split(piece.scales, 3, k))),
      column("opacity", piece.opacities),
      ...[0, 1, 2].map((k) => column(`f_dc_${k}`, split(piece.harmonics[0], 3, k))),
    ];
    const rest = piece.harmonics.slice(1);
    for (let c = 0; c < 3; c++) {
      rest.forEach((values, k) => properties.push(column(`f_rest_${c * rest.length + k}`, split(values, 3, c))));
    }
    const data = new pc.GSplatData([{ name: "vertex", count: piece.count, properties }] as any);
    (data as any).activated = true;
    const resource = new pc.GSplatResource(this.app.graphicsDevice, data);
    if (piece.shading) {
      resource.format.addExtraStreams([{ name: SHADING, format: pc.PIXELFORMAT_RGBA32F }]);
      const texture = resource.getTexture(SHADING)!;
      (texture.lock() as unknown as Float32Array).set(piece.shading);
      texture.unlock();
    }
    const entity = new pc.Entity(`object ${piece.object} in group ${piece.group.id}`);
    entity.addComponent("gsplat");
    entity.gsplat!.setWorkBufferModifier(kernel.modifier(piece.shading !== null));
    entity.gsplat!.setParameter("uTint", [0, 0, 0, 0]);
    entity.gsplat!.setParameter("uTurn", [0, 0, 0]);
    entity.gsplat!.resource = resource;
    this.app.root.addChild(entity);
    return entity;
  }

  // Move and shade all pieces to their state at a scene time.
  pose(t: number): void {
    const { model } = this;
    this.time = t;
    for (const { piece, entity } of this.drawn) {
      entity.enabled = this.shows(piece);
      const { place, turn } = model.worldPose(piece, t);
      entity.setLocalPosition(...place);
      entity.setLocalRotation(...turn);
      if (piece.shading && model.light) {
        const own = model.motion.data(piece.node, model.clock(t));
        const change = sub(rotate(conjugate(own.turn), model.light), model.light);
        entity.gsplat!.setParameter("uTurn", change);
      }
    }
    this.redraw();
  }

  private shows(piece: Piece): boolean {
    return !this.hidden.has(piece) && this.model.isThere(piece.group, this.time);
  }

  // Tint the pieces for which there is a colour, and show only visible ones.
  look(tints: Map<Piece, number[]>, hidden: Set<Piece>): void {
    this.hidden = hidden;
    for (const { piece, entity } of this.drawn) {
      entity.enabled = this.shows(piece);
      entity.gsplat!.setParameter("uTint", tints.get(piece) ?? [0, 0, 0, 0]);
      entity.gsplat!.workBufferUpdate = pc.WORKBUFFER_UPDATE_ONCE;
    }
    this.redraw();
  }

  view(eye: Eye, lens: Lens): void {
    [this.viewer, this.lens] = [eye, lens];
    this.eye.setPosition(...eye.place);
    this.eye.setRotation(...eye.turn);
    this.redraw();
  }

  redraw(): void {
    this.still = 0;
    this.app.renderNextFrame = true;
  }

  get settled(): boolean { return this.still >= STILL_FRAMES; }

  // Wait until the picture no longer changes.
  async settle(): Promise<void> {
    while (!this.settled) await this.frame();
  }

  private frame(): Promise<void> {
    this.app.renderNextFrame = true;
    return new Promise((done) => this.waiting.push(done));
  }

  // Picture as a data URL, read right after it was drawn.
  async picture(): Promise<string> {
    await this.settle();
    await this.frame();
    return this.canvas.toDataURL("image/png");
  }

  // The engine drops a request to sort while its worker is busy, and does not repeat it: ask again until nothing has
  // changed for a while.
  private tick(): void {
    if (this.settled && !this.app.xr?.active) return;
    this.still += 1;
    this.app.renderNextFrame = true;
    const director = (this.app.renderer as any).gsplatDirector;
    for (const camera of director?.camerasMap?.values() ?? []) {
      for (const layer of camera.layersMap?.values() ?? []) if (layer.gsplatManager) layer.gsplatManager.sortNeeded = true;
    }
  }

  private project(matrix: pc.Mat4): void {
    const { nearClip: near, farClip: far } = this.eye.camera!;
    const { fx, fy, cx, cy, width, height } = this.lens;
    matrix.set([
      (2 * fx) / width, 0, 0, 0,
      0, (2 * fy) / height, 0, 0,
      1 - (2 * cx) / width, (2 * cy) / height - 1, -(far + near) / (far - near), -1,
      0, 0, (-2 * far * near) / (far - near), 0,
    ]);
  }

  // Drawn pixels per CSS pixel.
  get ratio(): number { return Math.min(devicePixelRatio || 1, MAX_RATIO); }

  resize(): void {
    this.app.graphicsDevice.maxPixelRatio = this.ratio;
    this.app.resizeCanvas();
    this.redraw();
  }

  get canEnterVr(): boolean { return this.app.xr?.isAvailable(pc.XRTYPE_VR) ?? false; }

  // Call back as soon as VR becomes available or unavailable.
  onVr(changed: () => void): void { this.app.xr?.on(`available:${pc.XRTYPE_VR}`, changed); }

  enterVr(failed: (message: string) => void): void {
    this.eye.camera!.startXr(pc.XRTYPE_VR, pc.XRSPACE_LOCAL, {
      callback: (error) => { if (error) failed(error.message); },
    });
  }

  // Put the viewer where the camera was, upright and facing the same way.
  private enterRoom(): void {
    const { place, turn } = this.viewer, [x, , z] = rotate(turn, [0, 0, 1]);
    this.room.setPosition(...place);
    this.room.setEulerAngles(0, (180 / Math.PI) * Math.atan2(x, z), 0);
  }

  private leaveRoom(): void {
    this.room.setPosition(0, 0, 0);
    this.room.setEulerAngles(0, 0, 0);
    this.view(this.viewer, this.lens);
    setTimeout(() => this.resize()); // the engine refuses until the session is over
  }
}
