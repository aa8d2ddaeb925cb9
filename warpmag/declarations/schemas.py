"""USD schemas of warpmag. Together they list the whole table of attributes."""

from warpmag.declarations.attributes import Attribute, Schema
from warpmag.declarations.coils import Coil, FieldMap
from warpmag.declarations.magnets import Magnet, MagneticSettings

MAGNET_SCHEMA = Schema(
    "WarpmagMagnetAPI",
    Magnet,
    "Makes a rigid body, or one collider, a magnet: inducible (iron) or permanent.\n\n"
    "On a rigid body the schema applies to all its colliders, on a collider to that collider alone.",
    usd_only=(
        Attribute(
            "material", "token", "Material",
            "Name of a material, such as iron, mild-steel, N42 or hard-ferrite. For an inducible magnet it replaces "
            "saturation magnetization and susceptibility, and the curve if the material has a measured one. For a "
            "permanent magnet it sets the strength, and warpmag:magnetization the direction. The body has the density "
            "of the material if the stage has neither mass nor density.",
            uniform=True, field="material", default="",
        ),
        Attribute(
            "curve:h", "double[]", "Curve Fields",
            "Internal field H at the points of a measured curve, in place of warpmag:curve.",
            unit="ampere / meter", field="curve_fields", default=(),
        ),
        Attribute(
            "curve:b", "double[]", "Curve Flux Densities", "Flux density B at the points of a measured curve.",
            unit="tesla", field="curve_flux_densities", default=(),
        ),
        Attribute(
            "moment", "vector3f", "Moment", "Total magnetic moment in the world frame, time-sampled; a run writes it.",
            unit="ampere * meter * meter", field="moment", default=(0.0, 0.0, 0.0),
        ),
    ),
)  # fmt: skip

SCENE_SCHEMA = Schema("WarpmagSceneAPI", MagneticSettings, "Settings of the magnetic solve of the whole scene.")

COIL_SCHEMA = Schema(
    "WarpmagCoilAPI",
    Coil,
    "Makes a prim with a transform a coil. Its field acts on magnets. The coil moves with the nearest rigid body at or "
    "above the prim, and the reaction acts on that body. The axis of loops and solenoids is the z axis of the prim.",
    usd_only=(
        Attribute(
            "coil:current", "double", "Current",
            "Current of a coil with a resistance, time-sampled; a run writes it, and starts from it where it is given.",
            unit="ampere", field="current", default=0.0,
        ),
    ),
)  # fmt: skip

FIELD_MAP_SCHEMA = Schema(
    "WarpmagFieldMapAPI",
    FieldMap,
    "Makes a prim with a transform a field map: a field on a regular grid, interpolated by cubic convolution, and zero "
    "outside. The map moves with the nearest rigid body at or above the prim, and the reaction acts on that body.",
    usd_only=(
        Attribute(
            "fieldMap:counts", "int3", "Counts", "Number of nodes along each axis.",
            range="[2, inf)", uniform=True, field="counts",
        ),
    ),
)  # fmt: skip

SCHEMAS = (MAGNET_SCHEMA, SCENE_SCHEMA, COIL_SCHEMA, FIELD_MAP_SCHEMA)
"""All schemas, in the order of the documentation."""
