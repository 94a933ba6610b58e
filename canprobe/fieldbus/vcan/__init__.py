"""A real vcan0 where the kernel has none.

A command comes in; it runs where a SocketCAN interface vcan0 exists, and its exit status goes out. `launch` tries in
this order: the vcan0 that is there, one in a network namespace, one that root adds, and a user-mode Linux guest.

    launch        the ways to a vcan0, tried one after another
    guest         the guest, booted on this machine's own files in about three seconds
    guest_setup   runs inside the guest, as a script: modules and interfaces
    child         one command to its end: signals, time-out, exit status

Invariants: the command sees the same folder and environment everywhere, its streams pass byte for byte, signals reach
it, its status is passed through. Status 125 means that no vcan can be had, 124 that the time was up, 123 that the guest
ended by itself. Start reading at `launch.run_with_vcan`.
"""
