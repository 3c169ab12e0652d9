"""Motion of rigid bodies in contact, simulated by MuJoCo: materials, roll-outs, identification, many futures."""
