"""One building: its forms drawn and tried, the model judged, its record."""
