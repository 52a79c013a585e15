"""The two shaders of the viewport: one marches through a baked field, one lays its picture over the view with depth.

The march is that of nerfcore/kernels/voxel_march.py, on textures that the graphics card interpolates.
"""

from __future__ import annotations

from typing import Any

MOST_STEPS = 2000
LEAST_LEFT = 0.01  # of the light, at which a ray ends

MARCH = """
const int CELLS = 8;
const int VERTICES = 9;
const int COARSE = 5;
const int SLOTS = 32768;

vec3 grid_position(vec3 p)
{
  if (contracted == 0) {
    return p * 0.5 + 0.5;
  }
  float r = max(abs(p.x), max(abs(p.y), abs(p.z)));
  vec3 q = (r > 1.0) ? p * ((2.0 - 1.0 / r) / r) : p;
  return q * 0.25 + 0.5;
}

float exit_distance(vec3 u, vec3 inverse_d, float n, float radius, float border)
{
  vec3 cell = floor(u * n);
  vec3 low = max((cell - radius) / n, vec3(border));
  vec3 high = min((cell + 1.0 + radius) / n, vec3(1.0 - border));
  vec3 end = mix(low, high, greaterThan(inverse_d, vec3(0.0)));
  vec3 away = (end - u) * inverse_d;
  return max(min(away.x, min(away.y, away.z)), 0.0);
}

float leap(vec3 u, vec3 inverse_d, vec3 p, float distance_, float sides)
{
  if (contracted == 0) {
    return 2.0 * exit_distance(u, inverse_d, sides, distance_ - 1.0, 0.0);
  }
  float r = max(abs(p.x), max(abs(p.y), abs(p.z)));
  if (r <= 1.0) {
    return 4.0 * exit_distance(u, inverse_d, sides, distance_ - 1.0, 0.25);
  }
  vec3 block = floor(u * sides);
  vec3 below = u - (block - (distance_ - 1.0)) / sides;
  vec3 above = (block + distance_) / sides - u;
  vec3 free = min(below, above);
  return max(min(free.x, min(free.y, free.z)), 0.0) * max(3.0, 0.5 * r);
}

void slab(vec3 o, vec3 inverse_d, inout float low, inout float high)
{
  vec3 one = (-1.0 - o) * inverse_d;
  vec3 other = (1.0 - o) * inverse_d;
  vec3 near_side = min(one, other);
  vec3 far_side = max(one, other);
  low = max(low, max(near_side.x, max(near_side.y, near_side.z)));
  high = min(high, min(far_side.x, min(far_side.y, far_side.z)));
}

vec3 reciprocal(vec3 d)
{
  return 1.0 / mix(d, vec3(1e-9), lessThan(abs(d), vec3(1e-9)));
}

/* The vertex of a cell that adds most to its opacity. */
ivec3 strongest(ivec3 first, vec3 place)
{
  ivec3 nearest = first + ivec3(greaterThan(place, vec3(0.5)));
  if (texelFetch(t0, nearest, 0).a > 0.0) {
    return nearest;
  }
  float most = 0.0;
  for (int corner = 0; corner < 8; corner++) {
    ivec3 offset = ivec3(corner & 1, (corner >> 1) & 1, corner >> 2);
    vec3 share = mix(1.0 - place, place, vec3(offset));
    float part = share.x * share.y * share.z * texelFetch(t0, first + offset, 0).a;
    if (part > most) {
      most = part;
      nearest = first + offset;
    }
  }
  return nearest;
}

void main()
{
  vec2 ndc = gl_FragCoord.xy / size * 2.0 - 1.0;
  vec4 start = box_from_clip * vec4(ndc, -1.0, 1.0);
  vec4 stop = box_from_clip * vec4(ndc, 1.0, 1.0);
  vec3 o = start.xyz / start.w;
  vec3 way = stop.xyz / stop.w - o;
  float length_ = length(way);
  vec3 d = way / length_;
  vec3 inverse_d = reciprocal(d);
  float low = 0.0;
  float high = min(length_, far);
  if (contracted == 0) {
    slab(o, inverse_d, low, high);
  }
  else if (empty_distance > 0.0) {
    float entry = -1e9;
    float leave = 1e9;
    slab(o, inverse_d, entry, leave);
    low = max(low, min(empty_distance, 0.8 * entry));
  }
  if (cropped == 1) {
    vec3 co = (crop_from_box * vec4(o, 1.0)).xyz;
    vec3 cd = (crop_from_box * vec4(d, 0.0)).xyz;
    slab(co, reciprocal(cd), low, high);
  }
  vec3 texels = vec3(textureSize(t0, 0));
  ivec3 across = textureSize(t0, 0) / VERTICES;
  float t = low + 0.5 * step_;
  float left = 1.0;
  vec3 color = vec3(0.0);
  float sure = 0.0;
  float half_way = -1.0;
  /* Of a photo only blocks are asked for classes that have something of an edited one. */
  bool all_matter = classes > 0 && look > 0.0;
  bool classes_matter = all_matter;
  ivec3 block_before = ivec3(-1);
  float entry = 0.0;
  /* Changes with the direction are read once, where most of the light comes from: they vary little on a surface. */
  vec3 surface = vec3(0.0);
  float most_weight = 0.0;
  float photographed = 0.0;
  for (int n = 0; n < MOST_STEPS; n++) {
    if (t >= high || left < LEAST_LEFT) {
      break;
    }
    vec3 p = o + d * t;
    float r = max(abs(p.x), max(abs(p.y), abs(p.z)));
    float bin = (contracted == 1 && r > 1.0) ? step_ * r * sqrt(r) : step_;
    vec3 u = clamp(grid_position(p), 0.0, 1.0);
    vec3 x = u * float(blocks);
    ivec3 block = min(ivec3(x), ivec3(blocks - 1));
    if (any(notEqual(block, block_before))) {
      entry = texelFetch(index_, block, 0).r;
      block_before = block;
      if (edited == 1 && !all_matter && entry > 0.5) {
        int number = int(entry + 0.5) % SLOTS - 1;
        classes_matter = classes > 0 && texelFetch(marks, ivec2(number % 256, number / 256), 0).r > 0.5;
      }
    }
    if (entry <= 0.5) {
      t += leap(u, inverse_d, p, -entry, float(blocks)) + 0.5 * bin;
      continue;
    }
    vec3 local = (x - vec3(block)) * float(CELLS);
    int word = int(entry + 0.5);
    ivec3 upper = ivec3(greaterThanEqual(local, vec3(CELLS / 2)));
    if (((word / SLOTS) & (1 << (upper.x + 2 * upper.y + 4 * upper.z))) == 0) {
      t += leap(u, inverse_d, p, 1.0, 2.0 * float(blocks)) + 0.5 * bin;
      continue;
    }
    int slot = word % SLOTS - 1;
    ivec3 number = ivec3(slot % across.x, (slot / across.x) % across.y, slot / (across.x * across.y));
    ivec3 corner = number * VERTICES;
    vec3 place = (vec3(corner) + local + 0.5) / texels;
    vec4 base = texture(t0, place);
    if (base.a > 0.0) {
      float alpha = 1.0 - pow(max(1.0 - base.a * base.a, 0.0), exponent);
      ivec3 cell = min(ivec3(local), ivec3(CELLS - 1));
      ivec3 vertex = ivec3(0);
      int top = 0;
      int second = 0;
      float share = 0.0;
      vec4 first_look = vec4(0.0);
      vec4 second_look = vec4(0.0);
      if (classes_matter) {
        vertex = strongest(corner + cell, local - vec3(cell));
        vec4 named = texelFetch(t1, vertex, 0);
        top = int(named.r * 255.0 + 0.5);
        share = named.g;
        second = share < 1.0 ? int(named.b * 255.0 + 0.5) : top;
        first_look = texelFetch(lut, ivec2(top, 0), 0);
        second_look = second == top ? first_look : texelFetch(lut, ivec2(second, 0), 0);
        alpha *= share * first_look.a + (1.0 - share) * second_look.a;
      }
      if (alpha > 0.0005) {
        vec3 seen = base.rgb;
        float plain = 1.0;
        if (classes_matter) {
          /* tint, and the colour among the labels */
          vec4 first_more = texelFetch(lut, ivec2(top, 1), 0);
          vec4 second_more = second == top ? first_more : texelFetch(lut, ivec2(second, 1), 0);
          float first_tint = first_more.r;
          float second_tint = second_more.r;
          seen = share * mix(seen, first_look.rgb, first_tint) + (1.0 - share) * mix(seen, second_look.rgb, second_tint);
          vec3 labels = share * first_more.gba + (1.0 - share) * second_more.gba;
          seen = mix(seen, labels, min(look, 1.0));
          seen = mix(seen, vec3(max(share, 1.0 - share)), max(look - 1.0, 0.0));
          plain = (1.0 - share * first_tint - (1.0 - share) * second_tint) * (1.0 - min(look, 1.0));
        }
        color += left * alpha * seen;
        photographed += left * alpha * plain;
        if (left * alpha > most_weight) {
          most_weight = left * alpha;
          surface = (vec3(number * COARSE) + local * (float(COARSE - 1) / float(CELLS)) + 0.5) / vec3(across * COARSE);
        }
        float before = left;
        left *= 1.0 - alpha;
        if (before >= 0.5 && left < 0.5) {
          half_way = t;
        }
      }
    }
    t += bin;
  }
  float opacity = 1.0 - left;
  if (opacity < 0.02) {
    out_color = vec4(0.0);
    out_depth = 1.0;
    return;
  }
  if (photographed > 0.01) {
    vec3 slope = (texture(t2, surface).rgb - 0.5) * d.x + (texture(t3, surface).rgb - 0.5) * d.y +
                 (texture(t4, surface).rgb - 0.5) * d.z;
    color = clamp(color + photographed * slope * (2.0 * harmonic_range), 0.0, opacity);
  }
  /* Where it is thin all along, it stands at the end of it. */
  vec4 clip = clip_from_box * vec4(o + d * (half_way < 0.0 ? min(t, high) : half_way), 1.0);
  out_color = vec4(color, opacity);
  out_depth = clamp(clip.z / clip.w * 0.5 + 0.5, 0.0, 1.0);
}
"""

LAY = """
/* The picture is sRGB, the view's pixels are light where the framebuffer encodes them. */
vec3 light(vec3 c)
{
  vec3 low = c / 12.92;
  vec3 high = pow((max(c, 0.0) + 0.055) / 1.055, vec3(2.4));
  return mix(high, low, lessThanEqual(c, vec3(0.04045)));
}

void main()
{
  ivec2 texel = min(ivec2(gl_FragCoord.xy / size * vec2(textureSize(picture, 0))), textureSize(picture, 0) - 1);
  vec4 seen = texelFetch(picture, texel, 0);
  float depth = texelFetch(depths, texel, 0).r;
  float object_depth = texelFetch(objects, min(ivec2(gl_FragCoord.xy), textureSize(objects, 0) - 1), 0).r;
  if (seen.a < 0.02 || depth > object_depth) {
    discard;
  }
  out_color = vec4(light(clamp(seen.rgb / seen.a, 0.0, 1.0)) * seen.a, seen.a);
  gl_FragDepth = depth;
}
"""

VERTEX = "void main() { gl_Position = vec4(corner, 0.0, 1.0); }"


def march_shader() -> Any:
    """Draws a baked field into a picture: colour (sRGB, associated alpha) and depth of the view."""
    from gpu.types import GPUShaderCreateInfo

    info = GPUShaderCreateInfo()
    for place, (kind, name) in enumerate(
        [("FLOAT_3D", "index_"), *(("FLOAT_3D", f"t{n}") for n in range(5)), ("FLOAT_2D", "lut"), ("FLOAT_2D", "marks")]
    ):
        info.sampler(place, kind, name)
    for kind, name in (
        ("MAT4", "box_from_clip"), ("MAT4", "clip_from_box"), ("MAT4", "crop_from_box"), ("VEC2", "size"),
        ("FLOAT", "step_"), ("FLOAT", "exponent"), ("FLOAT", "far"), ("FLOAT", "empty_distance"),
        ("FLOAT", "harmonic_range"), ("FLOAT", "look"), ("INT", "blocks"), ("INT", "contracted"), ("INT", "cropped"),
        ("INT", "classes"), ("INT", "edited"),
    ):  # fmt: skip
        info.push_constant(kind, name)
    info.define("MOST_STEPS", str(MOST_STEPS))
    info.define("LEAST_LEFT", str(LEAST_LEFT))
    info.fragment_out(0, "VEC4", "out_color")
    info.fragment_out(1, "FLOAT", "out_depth")
    return _made(info, MARCH)


def lay_shader() -> Any:
    """Lays such a picture over the view."""
    from gpu.types import GPUShaderCreateInfo

    info = GPUShaderCreateInfo()
    info.sampler(0, "FLOAT_2D", "picture")
    info.sampler(1, "FLOAT_2D", "depths")
    info.sampler(2, "FLOAT_2D", "objects")  # depth of objects, where the view has none; else a pixel that hides nothing
    info.push_constant("VEC2", "size")
    if hasattr(info, "depth_write"):  # Blender before 4.4 knows OpenGL only, which takes any depth
        info.depth_write("ANY")
    info.fragment_out(0, "VEC4", "out_color")
    return _made(info, LAY)


def _made(info: Any, fragment: str) -> Any:
    import gpu

    info.vertex_in(0, "VEC2", "corner")
    info.vertex_source(VERTEX)
    info.fragment_source(fragment)
    return gpu.shader.create_from_info(info)


def whole_view(shader: Any) -> Any:
    """A batch that covers the view."""
    from gpu_extras.batch import batch_for_shader

    return batch_for_shader(shader, "TRIS", {"corner": ((-1, -1), (3, -1), (-1, 3))})
