"""Object identities: identity encodings, their losses and the labels of Gaussians."""
