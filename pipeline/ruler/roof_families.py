"""The five roof types of Hofmann, Maas and Streilein (2003), in which their tables count."""

from pipeline.model import RoofType

_FAMILIES = {
    RoofType.HALF_HIP: RoofType.GABLE,
    RoofType.PYRAMID: RoofType.HIP,
    **dict.fromkeys((RoofType.GAMBREL, RoofType.MANSARD, RoofType.BUTTERFLY, RoofType.SAWTOOTH), RoofType.COMBINATION),
    **dict.fromkeys((RoofType.BARREL, RoofType.CONE, RoofType.DOME), RoofType.COMBINATION),
    **dict.fromkeys((RoofType.L_SHAPE, RoofType.T_SHAPE, RoofType.CROSS), RoofType.COMBINATION),
}


def family_of(kind: RoofType) -> RoofType:
    """The name of a roof type in the paper; itself where it has none, as `unknown`."""
    return _FAMILIES.get(kind, kind)
