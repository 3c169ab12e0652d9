"""Import runs of other projects as a `Scene`."""
