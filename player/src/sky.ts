// Sky whose colour depends on the direction: a sphere of harmonics around the camera.
import * as pc from "playcanvas";
import type { Model } from "./model.ts";
import { conjugate, rows } from "./rigid.ts";

const VERTEX = `
attribute vec3 aPosition;
uniform mat4 matrix_viewProjection;
uniform vec3 view_position;
uniform vec4 uSize;
varying vec3 vDirection;
void main(void) {
  vDirection = aPosition;
  gl_Position = matrix_viewProjection * vec4(view_position + uSize.x * aPosition, 1.0);
}`;

const FRAGMENT = `
#include "gsplatEvalSHVS"
varying vec3 vDirection;
uniform mat4 uBack;
uniform vec3 uDc;
uniform vec3 uSky[SH_COEFFS];
void main(void) {
  vec3 sh[SH_COEFFS];
  for (int k = 0; k < SH_COEFFS; k++) sh[k] = uSky[k];
  vec3 dir = normalize(mat3(uBack) * vDirection);
  gl_FragColor = vec4(clamp(0.5 + 0.28209479177387814 * uDc + evalSH(sh, dir), 0.0, 1.0), 1.0);
}`;

// Entity of the sky, or null if its colour is the same in all directions.
export function skyEntity(device: pc.GraphicsDevice, model: Model): pc.Entity | null {
  const degree = Math.round(Math.sqrt(model.sky.length)) - 1;
  if (degree < 1 || model.sky.slice(1).every((row) => row.every((value) => value === 0))) return null;
  const material = new pc.ShaderMaterial({
    uniqueName: "sky", vertexGLSL: VERTEX, fragmentGLSL: FRAGMENT, attributes: { aPosition: pc.SEMANTIC_POSITION },
  });
  material.setDefine("SH_BANDS", String(degree));
  material.cull = pc.CULLFACE_NONE;
  material.depthTest = material.depthWrite = false;
  const [x, y, z] = rows(conjugate(model.motion.root.turn));
  material.setParameter("uBack", [x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, 0, 0, 0, 1]);
  material.setParameter("uSize", [10 * model.extent, 0, 0, 0]);
  material.setParameter("uDc", model.sky[0]);
  material.setParameter("uSky[0]", new Float32Array(model.sky.slice(1).flat()));
  material.update();
  const mesh = pc.Mesh.fromGeometry(device, new pc.SphereGeometry({ radius: 1, latitudeBands: 48, longitudeBands: 96 }));
  const instance = new pc.MeshInstance(mesh, material);
  instance.cull = false;
  instance.drawOrder = -1;
  const entity = new pc.Entity("sky");
  entity.addComponent("render", { meshInstances: [instance], castShadows: false });
  return entity;
}
