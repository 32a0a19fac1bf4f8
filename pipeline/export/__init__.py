"""Results as GeoParquet, OBJ and CityJSON."""
