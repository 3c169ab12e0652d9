"""Association of mask segments across images: one consistent numbering, from the Gaussians that each segment shows."""
