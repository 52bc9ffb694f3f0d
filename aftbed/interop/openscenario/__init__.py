"""Import of OpenSCENARIO XML: `importer` has the entry points."""
