"""A real vcan0 where the kernel has none: a namespace, or a user-mode Linux guest on this machine's files."""
