"""A real vcan0 where the kernel has none.

`launch.run_with_vcan` runs a command where a SocketCAN interface vcan0 exists. It tries in this order: the one that is
there, one in a network namespace, one that root adds, and a user-mode Linux guest. `guest` boots that guest on this
machine's own files in about three seconds: the command sees the same folder and environment, its streams pass byte
for byte, signals are forwarded, its status is passed through. `guest_setup` runs inside it, as a script.

Status 125 says that no vcan can be had, 124 that the time was up, 123 that the guest ended by itself.
"""
