"""GeoPackage and PMTiles."""
