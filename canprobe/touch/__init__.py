"""Pure mathematics of touch: surfaces, contact, the tactile patch and local shape from it."""
