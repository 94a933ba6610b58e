"""Scripts to start from: copy one, or open it as a notebook (`# %%` begins a cell)."""
