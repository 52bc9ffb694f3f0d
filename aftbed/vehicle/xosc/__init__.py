"""OpenSCENARIO XML files, read: the parts of `aftbed.vehicle.openscenario`."""
