// Binary glTF as `r5dgs export` writes it: JSON and float32 arrays.

export interface Accessor { bufferView: number; count: number; type: string }
export interface Primitive { attributes: Record<string, number> }
export interface Sampler { input: number; output: number }
export interface Channel { sampler: number; target: { node: number; path: string } }
export interface Animation { name: string; samplers: Sampler[]; channels: Channel[] }
export interface GltfNode {
  name: string;
  children?: number[];
  mesh?: number;
  camera?: number;
  translation?: number[];
  rotation?: number[];
  extras?: { r5dgs?: { group?: number; role?: string; object?: number; camera?: number } };
}
export interface Tree {
  nodes: GltfNode[];
  meshes: { primitives: Primitive[] }[];
  accessors: Accessor[];
  bufferViews: { byteOffset: number; byteLength: number }[];
  animations?: Animation[];
  scenes: { name: string; nodes: number[]; extras: { r5dgs: Record<string, any> } }[];
}

export class Glb {
  readonly tree: Tree;
  private readonly start: number;

  constructor(private readonly data: ArrayBuffer) {
    const view = new DataView(data);
    if (data.byteLength < 20 || view.getUint32(0, true) !== 0x46546c67) throw new Error("this is no binary glTF file");
    const length = view.getUint32(12, true);
    this.tree = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 20, length)));
    this.start = 28 + length;
    if (this.tree.scenes?.[0]?.extras?.r5dgs?.format !== "r5dgs glb") {
      throw new Error("expected a file of 'r5dgs export'");
    }
  }

  array(accessor: number): Float32Array {
    const view = this.tree.bufferViews[this.tree.accessors[accessor].bufferView];
    return new Float32Array(this.data, this.start + view.byteOffset, view.byteLength / 4);
  }
}
