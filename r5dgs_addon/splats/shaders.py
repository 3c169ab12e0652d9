"""Shaders of the viewport splats: one draws Gaussians into a buffer, the other pastes that buffer into the viewport."""

from __future__ import annotations

import functools

import gpu

from ...r5dgs_core import errors
from . import gaussian_table

WIDEST = 16384  # texels of a row of a texture, at most
# Texels of each group: three rows of its matrix to the camera; tint (the color itself if the fourth component is 1);
# change of the light; viewpoint; the light.
POSE_TEXELS = 7


class CompileError(errors.R5dgsError):
    """A shader does not compile on this graphics card."""


@functools.cache
def width() -> int:
    """Texels of a row of a texture. It is the same for all tables, so that one shader serves them all."""
    return min(gpu.capabilities.max_texture_size_get(), WIDEST)


_HARMONICS = """
/* Color of harmonics in the direction d, from coefficients packed in texels of COEFFICIENTS from `at` on. */
float coefficient(ivec2 at, int k) { return texelFetch(COEFFICIENTS, at + ivec2(k / 4, 0), 0)[k % 4]; }
vec3 harmonics(ivec2 at, vec3 d, int degree)
{
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  float values[15];
  values[0] = -0.4886025119029199 * y;
  values[1] = 0.4886025119029199 * z;
  values[2] = -0.4886025119029199 * x;
  values[3] = 1.0925484305920792 * x * y;
  values[4] = -1.0925484305920792 * y * z;
  values[5] = 0.31539156525252005 * (2.0 * zz - xx - yy);
  values[6] = -1.0925484305920792 * x * z;
  values[7] = 0.5462742152960396 * (xx - yy);
  values[8] = -0.5900435899266435 * y * (3.0 * xx - yy);
  values[9] = 2.890611442640554 * x * y * z;
  values[10] = -0.4570457994644658 * y * (4.0 * zz - xx - yy);
  values[11] = 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
  values[12] = -0.4570457994644658 * x * (4.0 * zz - xx - yy);
  values[13] = 1.445305721320277 * z * (xx - yy);
  values[14] = -0.5900435899266435 * x * (xx - 3.0 * yy);
  int count = (degree + 1) * (degree + 1) - 1;
  vec3 sum = vec3(0.0);
  for (int k = 0; k < count; k++) {
    vec3 c = vec3(coefficient(at, 3 * k), coefficient(at, 3 * k + 1), coefficient(at, 3 * k + 2));
    sum += values[k] * c;
  }
  return sum;
}
"""

_SPLAT_VERTEX = (
    _HARMONICS
    + """
mat3 rotation(vec4 q)  /* wxyz of any length */
{
  float w = q.x;
  vec3 v = q.yzw;
  float s = 2.0 / dot(q, q);
  return mat3(1.0 - s * (v.y * v.y + v.z * v.z), s * (v.x * v.y + w * v.z), s * (v.x * v.z - w * v.y),
              s * (v.x * v.y - w * v.z), 1.0 - s * (v.x * v.x + v.z * v.z), s * (v.y * v.z + w * v.x),
              s * (v.x * v.z + w * v.y), s * (v.y * v.z - w * v.x), 1.0 - s * (v.x * v.x + v.y * v.y));
}
void main()
{
  int place_of = gl_InstanceID;
  int id = int(texelFetch(order, ivec2(place_of % WIDTH, place_of / WIDTH), 0).r);
  ivec2 at = ivec2((id % (WIDTH / GEOMETRY)) * GEOMETRY, id / (WIDTH / GEOMETRY));
  vec4 place = texelFetch(geometry, at, 0);
  vec4 turn = texelFetch(geometry, at + ivec2(1, 0), 0);  /* wxyz */
  vec3 size = texelFetch(geometry, at + ivec2(2, 0), 0).xyz;
  ivec2 first = ivec2((id % (WIDTH / LOOK)) * LOOK, id / (WIDTH / LOOK));
  vec4 base = texelFetch(looks, first, 0);
  int number = int(place.w);
  ivec2 pose = ivec2((number % (WIDTH / POSE_TEXELS)) * POSE_TEXELS, number / (WIDTH / POSE_TEXELS));
  vec4 r0 = texelFetch(poses, pose, 0);
  vec4 r1 = texelFetch(poses, pose + ivec2(1, 0), 0);
  vec4 r2 = texelFetch(poses, pose + ivec2(2, 0), 0);
  vec4 h = vec4(place.xyz, 1.0);
  vec3 p = vec3(dot(r0, h), dot(r1, h), dot(r2, h));  /* camera space, looking along -z */
  vec4 clip = projection * vec4(p, 1.0);
  delta = vec2(0.0);
  conic = vec3(0.0);
  depths = vec3(0.0);
  paint = vec4(0.0);
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  /* outside: the quad is clipped */
  bool parallel = projection[3][3] > 0.5;
  if ((!parallel && -p.z < view.z) || base.a * 255.0 < 1.0 || dot(turn, turn) <= 0.0) { return; }
  mat3 R = rotation(turn);
  mat3 M = transpose(mat3(r0.xyz, r1.xyz, r2.xyz)) * mat3(size.x * R[0], size.y * R[1], size.z * R[2]);
  mat3 C = M * transpose(M);
  vec2 f = vec2(projection[0][0], projection[1][1]) * 0.5 * view.xy;
  vec3 jx, jy;
  if (parallel) { jx = vec3(f.x, 0.0, 0.0); jy = vec3(0.0, f.y, 0.0); }
  else {
    float inverse = 1.0 / -p.z;
    vec2 slope = clamp(p.xy * inverse, slopes.xz, slopes.yw);
    jx = vec3(f.x, 0.0, f.x * slope.x) * inverse;
    jy = vec3(0.0, f.y, f.y * slope.y) * inverse;
  }
  vec3 cx = C * jx;
  float a = dot(jx, cx) + 0.3, b = dot(jy, cx), c = dot(jy, C * jy) + 0.3;
  float det = a * c - b * b;
  if (!(det > 0.0)) { return; }  /* also if it is not a number */
  conic = vec3(c, -b, a) / det;
  /* Depth at which the Gaussian is densest along the ray of a pixel: linear in the offset from its centre. */
  vec2 along = -vec2(cx.z, (C * jy).z);
  depths = vec3(-p.z, conic.x * along.x + conic.y * along.y, conic.y * along.x + conic.z * along.y);
  vec3 color = 0.5 + 0.28209479177387814 * base.rgb;
#if TURNED > 0
  vec4 bound = texelFetch(looks, first + ivec2(1 + SHADED, 0), 0);
  mat3 back = dot(bound, bound) > 0.0 ? rotation(bound) * transpose(R) : mat3(1.0);  /* to the bind state */
#endif
#if DEGREE > 0
  vec4 eye = texelFetch(poses, pose + ivec2(5, 0), 0);  /* viewpoint, or with w = 0 the line of sight */
  vec3 sight = eye.w * place.xyz - eye.xyz;
#if TURNED > 0
  sight = back * sight;
#endif
  float far_off = length(sight);
  if (far_off > 0.0) { color += harmonics(first + ivec2(1 + SHADED + TURNED, 0), sight / far_off, DEGREE); }
#endif
  color = max(color, 0.0);
#if SHADED > 0
  vec4 light = texelFetch(looks, first + ivec2(1, 0), 0);
  vec3 change = texelFetch(poses, pose + ivec2(4, 0), 0).xyz;
#if TURNED > 0
  vec3 source = texelFetch(poses, pose + ivec2(6, 0), 0).xyz;
  change = back * (change + source) - source;
#endif
  color *= max(light.w + dot(light.xyz, change), 0.0);
#endif
  vec4 tint = texelFetch(poses, pose + ivec2(3, 0), 0);
  paint = vec4(tint.a > 0.5 ? tint.rgb : color * tint.rgb, base.a);
  float reach = 2.0 * log(base.a * 255.0);  /* alpha is 1/255 where the exponent is this */
  delta = corner * sqrt(reach * vec2(a, c));
  gl_Position = clip + vec4(2.0 * delta / view.xy * clip.w, 0.0, 0.0);
  gl_Position.z = clamp(gl_Position.z, -clip.w, clip.w);  /* no far plane, as in the core */
}
"""
)
_SPLAT_FRAGMENT = """
void main()
{
  float power = conic.x * delta.x * delta.x + 2.0 * conic.y * delta.x * delta.y + conic.z * delta.y * delta.y;
  float alpha = min(0.99, paint.a * exp(-0.5 * power));
  if (alpha < 1.0 / 255.0) { discard; }
  if (view.w > 0.5) {
    float solid = 2.0 * texelFetch(meshes, ivec2(gl_FragCoord.xy), 0).r - 1.0;
    bool parallel = projection[3][3] > 0.5;
    float limit = parallel ? projection[3][2] - solid : projection[3][2];
    limit /= parallel ? projection[2][2] : solid + projection[2][2];
    if (solid < 1.0 && depths.x + dot(depths.yz, delta) > limit) { discard; }
  }
  picture = vec4(paint.rgb * alpha, alpha);
}
"""

_PASTE_VERTEX = "void main() { uv = corner; gl_Position = vec4(corner, 0.0, 1.0); }"
# A viewport's framebuffer is that of Blender's overlay, which is merged with the scene by this gamma, not by the sRGB
# curve. Over a known background color, the result is exact; over meshes, soft edges are blended in that gamma.
_PASTE_FRAGMENT = (
    _HARMONICS
    + """
void main()
{
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 c = texelFetch(splats, at, 0);
  float hole = has_holes > 0 ? texelFetch(holes, at, 0).r : 0.0;  /* of hold-outs, also in the sky */
  bool open = meshes_drawn < 1 || texelFetch(meshes, at, 0).r >= 1.0;  /* nothing solid in this pixel */
  float cover = c.a - hole;
  if (sky_degree >= 0 && open) {
    vec4 ray = to_world * vec4(uv, 1.0, 1.0);
    vec3 d = normalize(ray.xyz);
    vec3 sky = 0.5 + 0.28209479177387814 * texelFetch(sky_terms, ivec2(0, 0), 0).rgb;
    if (sky_degree > 0) { sky += harmonics(ivec2(1, 0), d, sky_degree); }
    c.rgb += clamp(sky, 0.0, 1.0) * (1.0 - c.a);
    cover = 1.0 - hole;
  }
  if (cover <= 1e-6) { discard; }
  vec3 s = clamp(c.rgb / cover, 0.0, 1.0);
  if (overlay < 1) { picture = vec4(s * cover, cover); return; }
  vec3 below = open ? behind : vec3(0.5);
  vec3 b = pow(below, vec3(2.2)) * (1.0 - cover);
  picture = vec4(max(pow(s * cover + below * (1.0 - cover), vec3(2.2)) - b, vec3(0.0)), cover);
}
"""
)


def splats(degree: int, shaded: bool, turned: bool, texels: int) -> gpu.types.GPUShader:
    """Compile the shader that draws Gaussians.

    Args:
        degree: Degree of the harmonics in the table.
        shaded: True if the table has shading.
        turned: True if it has bind states.
        texels: Texels of the look of each Gaussian.

    Raises:
        CompileError: The graphics card's driver refuses it.
    """
    info = _info(_SPLAT_VERTEX, _SPLAT_FRAGMENT, ("geometry", "looks", "poses", "order", "meshes"))
    for kind, name in (("MAT4", "projection"), ("VEC4", "view"), ("VEC4", "slopes")):
        info.push_constant(kind, name)
    between = gpu.types.GPUStageInterfaceInfo("r5dgs_splat")
    between.smooth("VEC2", "delta")
    between.flat("VEC3", "conic")
    between.flat("VEC4", "paint")
    between.flat("VEC3", "depths")
    info.vertex_out(between)
    info.define("COEFFICIENTS", "looks")
    defines = {
        "DEGREE": degree,
        "SHADED": int(shaded),
        "TURNED": int(turned),
        "GEOMETRY": gaussian_table.GEOMETRY,
        "LOOK": texels,
    }
    for name, value in {**defines, "WIDTH": width(), "POSE_TEXELS": POSE_TEXELS}.items():
        info.define(name, str(value))
    return _compile(info)


def paste() -> gpu.types.GPUShader:
    """Compile the shader that draws the buffer into a viewport.

    Raises:
        CompileError: The graphics card's driver refuses it.
    """
    info = _info(_PASTE_VERTEX, _PASTE_FRAGMENT, ("splats", "holes", "meshes", "sky_terms"))
    for kind, name in (("MAT4", "to_world"), ("VEC3", "behind")):
        info.push_constant(kind, name)
    for name in ("sky_degree", "meshes_drawn", "has_holes", "overlay"):
        info.push_constant("INT", name)
    between = gpu.types.GPUStageInterfaceInfo("r5dgs_paste")
    between.smooth("VEC2", "uv")
    info.vertex_out(between)
    info.define("COEFFICIENTS", "sky_terms")
    return _compile(info)


def depth() -> gpu.types.GPUShader:
    """Compile the shader that draws the depth of triangles.

    Raises:
        CompileError: The graphics card's driver refuses it.
    """
    info = gpu.types.GPUShaderCreateInfo()
    info.vertex_in(0, "VEC3", "place")
    info.push_constant("MAT4", "to_clip")
    info.fragment_out(0, "VEC4", "picture")
    info.vertex_source("void main() { gl_Position = to_clip * vec4(place, 1.0); }")
    info.fragment_source("void main() { picture = vec4(gl_FragCoord.z); }")
    return _compile(info)


def _compile(info: gpu.types.GPUShaderCreateInfo) -> gpu.types.GPUShader:
    try:
        return gpu.shader.create_from_info(info)
    except Exception as error:  # Blender has no narrower class for this
        raise CompileError(str(error)) from error


def _info(vertex: str, fragment: str, textures: tuple[str, ...]) -> gpu.types.GPUShaderCreateInfo:
    info = gpu.types.GPUShaderCreateInfo()
    info.vertex_in(0, "VEC2", "corner")
    for slot, name in enumerate(textures):
        info.sampler(slot, "FLOAT_2D", name)
    info.fragment_out(0, "VEC4", "picture")
    info.vertex_source(vertex)
    info.fragment_source(fragment)
    return info
