"""Import of training runs of other projects as a `Scene`."""
