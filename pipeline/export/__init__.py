"""Results as GeoParquet, CityJSON, OBJ and GLB."""
