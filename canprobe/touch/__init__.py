"""Pure mathematics of touch: surfaces, contact, the servo, the tactile patch and local shape from it.

`patch/` reads tactile images, `estimate/` finds the local shape from contacts.
"""
