"""Where on Earth the exported files lie, for programs of maps: our own JSON, and the XML that ContextCapture writes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

import numpy as np

from stages.geometry.earth import earth_centred_from_local
from stages.geometry.place import Place

if TYPE_CHECKING:
    from jaxtyping import Float


def georeference(place: Place, gltf_from_world: Float[np.ndarray, "3 3"], geoid: float | None) -> dict[str, Any] | None:
    """How coordinates of the files lead to those of the Earth, a map or the control points; None where none do.

    Args:
        gltf_from_world: the rotation to Y up.
        geoid: metres above the ellipsoid of what altitudes count from; None: not known, taken for zero.
    """
    if place.origin is None and place.offset is None:
        return None
    found: dict[str, Any] = {
        "units": "metres",
        "axes": {
            "obj, ply, stl": "x east, y north, z up" if place.origin or place.crs else "as those of the control points",
            "glb, usdz": "those of the OBJ, turned by gltf_from_world_rotation",
            "points.laz": "those of the OBJ, with the offset added where there is one",
        },
        "gltf_from_world_rotation": gltf_from_world.tolist(),
        "control_residual_m": place.control_residual,
        "gps_residual_m": place.gps_residual,
    }
    if place.origin is not None:
        matrix = earth_centred_from_local(place.origin, geoid or 0.0)
        keys = ("latitude_deg", "longitude_deg", "altitude_m")
        found |= {
            "origin": dict(zip(keys, place.origin, strict=True)),
            "geoid_m": geoid,
            "earth_centred_from_world": matrix.tolist(),  # EPSG:4978, as 3D Tiles want it
        }
    else:
        found |= {"crs": place.crs or None, "offset": place.offset}
    return found


def metadata_xml(place: Place, geoid: float | None) -> str | None:
    """`metadata.xml` of ContextCapture, which importers of meshes into maps read; None where no map is known.

    Args:
        geoid: see `georeference`.
    """
    if place.origin is not None:
        latitude, longitude, altitude = place.origin
        system, origin = f"ENU:{latitude:.9f},{longitude:.9f}", (0.0, 0.0, altitude + (geoid or 0.0))
    elif place.crs and place.offset is not None:
        system, origin = place.crs, place.offset
    else:
        return None
    numbers = ",".join(f"{value:.3f}" for value in origin)
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n<ModelMetadata version="1">\n'
        f" <SRS>{escape(system)}</SRS>\n <SRSOrigin>{numbers}</SRSOrigin>\n</ModelMetadata>\n"
    )
