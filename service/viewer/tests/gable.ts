/** A gable house of 10 by 6 m, eaves at 3 m and ridge at 5 m above its floor, as CityJSONSeq, in millimetres. */

export const METADATA = {
  type: "CityJSON",
  version: "2.0",
  transform: { scale: [0.001, 0.001, 0.001], translate: [565000, 5934000, 80] },
  metadata: {
    referenceSystem: "https://www.opengis.net/def/crs/EPSG/0/25832",
    geographicalExtent: [565000, 5934000, 90, 565010, 5934006, 95],
  },
  CityObjects: {},
  vertices: [],
};

export const GABLE = {
  type: "CityJSONFeature",
  id: "house",
  CityObjects: {
    house: {
      type: "Building",
      attributes: { status: "ok", roof_type: "gable", height_m: 5, footprint_area_m2: 60, reason_detail: "" },
      children: ["house-0"],
    },
    "house-0": {
      type: "BuildingPart",
      parents: ["house"],
      geometry: [
        {
          type: "Solid",
          lod: "2.2",
          boundaries: [
            [
              [[4, 5, 9, 8]],
              [[6, 7, 8, 9]],
              [[0, 1, 5, 4]],
              [[2, 3, 7, 6]],
              [[1, 2, 6, 9, 5]],
              [[3, 0, 4, 8, 7]],
              [[0, 3, 2, 1]],
            ],
          ],
          semantics: {
            surfaces: [
              { type: "RoofSurface", plane_id: 0 },
              { type: "RoofSurface", plane_id: 1 },
              { type: "WallSurface" },
              { type: "GroundSurface" },
            ],
            values: [[0, 1, 2, 2, 2, 2, 3]],
          },
        },
      ],
    },
  },
  vertices: [
    [0, 0, 10000],
    [10000, 0, 10000],
    [10000, 6000, 10000],
    [0, 6000, 10000],
    [0, 0, 13000],
    [10000, 0, 13000],
    [10000, 6000, 13000],
    [0, 6000, 13000],
    [0, 3000, 15000],
    [10000, 3000, 15000],
  ],
};
