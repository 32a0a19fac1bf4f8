"""The colours of roof types, in pictures and on the page (`service/viewer/src/words/roof_types.ts`)."""

from pipeline.model import RoofType

ROOF_COLOURS = {
    RoofType.FLAT: "#56b4e9",
    RoofType.PENT: "#009e73",
    RoofType.GABLE: "#e69f00",
    RoofType.HALF_HIP: "#b3831a",
    RoofType.HIP: "#cc79a7",
    RoofType.PYRAMID: "#9b4f7d",
    RoofType.GAMBREL: "#8c5a00",
    RoofType.MANSARD: "#6e3a5a",
    RoofType.BUTTERFLY: "#5fc9a8",
    RoofType.SAWTOOTH: "#00634a",
    RoofType.L_SHAPE: "#8db7e0",
    RoofType.T_SHAPE: "#4f86c6",
    RoofType.CROSS: "#1d4f8f",
    RoofType.BARREL: "#a8a29a",
    RoofType.CONE: "#7d766c",
    RoofType.DOME: "#524c44",
    RoofType.COMBINATION: "#0072b2",
    RoofType.UNKNOWN: "#8d99a6",
    RoofType.NONE: "#dddddd",
}
"""The colour of each roof type in full light, after Okabe and Ito (2008); rarer ones have shades of similar ones."""
