// The rasterizer's kernel in PlayCanvas' shaders: fall-off and cut-off at an opacity of 1/255, cap of 0.99, near plane
// of the centres, and the frustum clamp of the projection.
import * as pc from "playcanvas";

const LOG_255 = "5.541263545158426"; // -log of the smallest opacity
const REACH = "2.3539888"; // its square root: reach in units of sqrt(2) standard deviations

function patched(text: string, changes: [string, string][]): string {
  for (const [before, after] of changes) {
    if (!text.includes(before)) throw new Error(`this version of PlayCanvas has no “${before}” in its shader`);
    text = text.replaceAll(before, after);
  }
  return text;
}

export function install(device: pc.GraphicsDevice, params: pc.Scene["gsplat"]): void {
  const all = pc.ShaderChunks.get(device, "glsl");
  const own = params.material.getShaderChunks("glsl");
  const precise: [string, string] = ["mediump", "highp"];
  own.set("gsplatPS", patched(all.get("gsplatPS")!, [
    ["normExp(A) * gaussianColor.a", `min(0.99, exp(A * -${LOG_255}) * gaussianColor.a)`], precise,
  ]));
  own.set("gsplatCornerVS", patched(all.get("gsplatCornerVS")!, [
    ["2.0 * min(sqrt(2.0 * lambda", `${REACH} * min(sqrt(2.0 * lambda`],
    ["max(mid - radius, 0.1)", "max(mid - radius, 0.01)"],
    // The engine's unit is half a pixel, so its low-pass filter of 0.3 is that of 0.075 square pixels.
    ["cov[0][0] + 0.3;", "cov[0][0] + 1.2;"],
    ["cov[1][1] + 0.3;", "cov[1][1] + 1.2;"],
    ["min(1024.0, min(viewport_size.x, viewport_size.y))", "16384.0"],
    ["vec2 J2 = -J1 / vp.z * vp.xy;",
      "vec2 most = 1.3 / abs(vec2(center.projMat00, center.projMat11)); vec2 J2 = -J1 * clamp(vp.xy / vp.z, -most, most);"],
  ]));
  own.set("gsplatCenterVS", patched(all.get("gsplatCenterVS")!, [["centerView.z > 0.0", "centerView.z > -camera_params.z"]]));
  own.set("gsplatVS", patched(all.get("gsplatVS")!, [
    ["clipCorner(corner, clr.w);",
      `float reach = min(1.0, sqrt(max(0.0, log(clr.w * 255.0)) / ${LOG_255})); corner.offset *= reach; corner.uv *= reach;`],
    precise,
  ]));
  params.material.update();
}

// Code that the copy of the Gaussians into world space runs: shading that follows rotation, then a tint.
export function modifier(shaded: boolean): { glsl: string } {
  const lit = shaded ? "vec4 lit = loadShading(); color.rgb *= max(0.0, lit.w + dot(lit.xyz, uTurn));" : "";
  return {
    glsl: `uniform vec4 uTint; uniform vec3 uTurn;
void modifySplatCenter(inout vec3 center) {}
void modifySplatRotationScale(vec3 before, vec3 after, inout vec4 rotation, inout vec3 scale) {}
void modifySplatColor(vec3 center, inout vec4 color) {
  color.rgb = max(color.rgb, 0.0); ${lit} color.rgb = mix(color.rgb, uTint.rgb, uTint.a);
}`,
  };
}
