"""The contact patch in a tactile image: force, centroid, moments, and curvature from them."""
