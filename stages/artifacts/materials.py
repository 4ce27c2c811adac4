"""What materials publishes: what the surface is made of, and the light it was photographed in."""

from __future__ import annotations

from stages.artifacts.artifact import place_artifact

# 8-bit sRGB base colour without light in it; row 0 is v = 1, as in all textures.
MATERIAL_COLOR = place_artifact("materials", "base_color.png", optional=True)
# 8-bit linear RGB: occlusion, roughness and metalness, as glTF packs them.
ORM = place_artifact("materials", "orm.png", optional=True)
# 8-bit grey, what the photos tell of each texel, see `stages.shading.texels.Told`.
KNOWN = place_artifact("materials", "known.png", optional=True)
# The light as an environment map in the frame of the GLB, see `stages.light.environment`; float32 and RGBE.
LIGHT = place_artifact("materials", "light.exr", optional=True)
LIGHT_HDR = place_artifact("materials", "light.hdr", optional=True)
# Its spherical harmonics up to degrees 2 and 3, with their convention.
LIGHT_HARMONICS = place_artifact("materials", "light.json", optional=True)
