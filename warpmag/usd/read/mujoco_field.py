"""Reads the magnetic flux that an importer of MJCF authored on a PhysicsScene."""

from pxr import Usd

from warpmag.declarations.attributes import attributes_of
from warpmag.declarations.magnets import MagneticSettings
from warpmag.declarations.mujoco_field import ATTRIBUTE, external_fields, field_message
from warpmag.usd.schemas import finite_vector
from warpmag.usd.values import Finding


def with_mujoco_field(prim: Usd.Prim, settings: MagneticSettings) -> tuple[MagneticSettings, list[Finding]]:
    """Return the settings of a PhysicsScene with the flux of MJCF as external field, and a warning about it.

    An authored ``warpmag:externalField`` takes precedence. A flux that is not finite raises :class:`InputError`.
    """
    (name,) = (row.usd_name for row in attributes_of(MagneticSettings) if row.field == "external_field")
    flux = prim.GetAttribute(ATTRIBUTE)
    if not flux.HasAuthoredValue() or prim.GetAttribute(name).HasAuthoredValue():
        return settings, []
    fields = external_fields(finite_vector(ATTRIBUTE, flux.Get(Usd.TimeCode.EarliestTime())))
    if not fields.any():
        return settings, []
    message = f"{field_message(fields)}; {name} sets another"
    return settings.replaced(external_field=tuple(fields[0].tolist())), [
        Finding(str(prim.GetPath()), message, "warning")
    ]
