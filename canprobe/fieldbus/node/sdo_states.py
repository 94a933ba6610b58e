"""The state machine of an SDO server as a table.

    IDLE → (initiate) DOWNLOAD, UPLOAD: a segment stays or, the last one, returns to IDLE
         → BLOCK_DOWNLOAD → BLOCK_DOWNLOAD_END → IDLE
         → BLOCK_UPLOAD_START → BLOCK_UPLOAD → BLOCK_UPLOAD_END → IDLE

Expedited transfers begin and end in IDLE. A request that is not in the table is aborted (05040001h), and every abort,
the time-out and the stopped state lead to IDLE. An initiate request takes the place of an open transfer, so that a
master that was restarted is served at once. Source: CiA 301, "SDO protocols".
"""

from __future__ import annotations

from enum import IntEnum, auto


class SdoState(IntEnum):
    """States of a server, which waits for a new request or for the next frame of a transfer."""

    IDLE = auto()
    DOWNLOAD = auto()
    UPLOAD = auto()
    BLOCK_DOWNLOAD = auto()
    BLOCK_DOWNLOAD_END = auto()
    BLOCK_UPLOAD_START = auto()
    BLOCK_UPLOAD = auto()
    BLOCK_UPLOAD_END = auto()


class SdoRequest(IntEnum):
    """Kinds of a client's frames, by the command byte."""

    INITIATE_DOWNLOAD = auto()
    INITIATE_UPLOAD = auto()
    DOWNLOAD_SEGMENT = auto()
    UPLOAD_SEGMENT = auto()
    INITIATE_BLOCK_DOWNLOAD = auto()
    BLOCK_SEGMENT = auto()
    END_BLOCK_DOWNLOAD = auto()
    INITIATE_BLOCK_UPLOAD = auto()
    START_BLOCK_UPLOAD = auto()
    ACKNOWLEDGE_BLOCK = auto()
    END_BLOCK_UPLOAD = auto()
    ABORT = auto()
    UNKNOWN = auto()


_S, _R = SdoState, SdoRequest
_COMMAND_STATES = tuple(state for state in SdoState if state is not SdoState.BLOCK_DOWNLOAD)
_INITIATE_GOALS = {
    _R.INITIATE_DOWNLOAD: (_S.IDLE, _S.DOWNLOAD),  # expedited; segmented
    _R.INITIATE_UPLOAD: (_S.IDLE, _S.UPLOAD),
    _R.INITIATE_BLOCK_DOWNLOAD: (_S.BLOCK_DOWNLOAD,),
    _R.INITIATE_BLOCK_UPLOAD: (_S.BLOCK_UPLOAD_START, _S.IDLE, _S.UPLOAD),  # the last two by the protocol switch
}
SDO_TRANSITIONS: dict[tuple[SdoState, SdoRequest], tuple[SdoState, ...]] = {
    **{(state, request): goals for state in _COMMAND_STATES for request, goals in _INITIATE_GOALS.items()},
    **{(state, _R.ABORT): (_S.IDLE,) for state in SdoState},
    (_S.DOWNLOAD, _R.DOWNLOAD_SEGMENT): (_S.DOWNLOAD, _S.IDLE),
    (_S.UPLOAD, _R.UPLOAD_SEGMENT): (_S.UPLOAD, _S.IDLE),
    (_S.BLOCK_DOWNLOAD, _R.BLOCK_SEGMENT): (_S.BLOCK_DOWNLOAD, _S.BLOCK_DOWNLOAD_END),
    (_S.BLOCK_DOWNLOAD_END, _R.END_BLOCK_DOWNLOAD): (_S.IDLE,),
    (_S.BLOCK_UPLOAD_START, _R.START_BLOCK_UPLOAD): (_S.BLOCK_UPLOAD,),
    (_S.BLOCK_UPLOAD, _R.ACKNOWLEDGE_BLOCK): (_S.BLOCK_UPLOAD, _S.BLOCK_UPLOAD_END),
    (_S.BLOCK_UPLOAD_END, _R.END_BLOCK_UPLOAD): (_S.IDLE,),
}
"""States that may follow a request without an error, by state and request; an error leads to IDLE with an abort."""
_ABORT_COMMAND = 0x80
_SPECIFIED_REQUESTS = (_R.DOWNLOAD_SEGMENT, _R.INITIATE_DOWNLOAD, _R.INITIATE_UPLOAD, _R.UPLOAD_SEGMENT)
_BLOCK_UPLOAD_REQUESTS = (_R.INITIATE_BLOCK_UPLOAD, _R.END_BLOCK_UPLOAD, _R.ACKNOWLEDGE_BLOCK, _R.START_BLOCK_UPLOAD)
_BLOCK_DOWNLOAD_REQUESTS = (_R.INITIATE_BLOCK_DOWNLOAD, _R.END_BLOCK_DOWNLOAD)


def _read(command: int) -> SdoRequest:
    specifier = command >> 5
    if command == _ABORT_COMMAND:
        return _R.ABORT
    if specifier == 5:
        return _BLOCK_UPLOAD_REQUESTS[command & 3]
    if specifier == 6:
        return _BLOCK_DOWNLOAD_REQUESTS[command & 1]
    return _SPECIFIED_REQUESTS[specifier] if specifier < 4 else _R.UNKNOWN


_REQUESTS = tuple(_read(command) for command in range(256))


def request_of(state: SdoState, command: int) -> SdoRequest:
    """Request of a command byte; during a block download every frame but an abort is a numbered segment."""
    if state is SdoState.BLOCK_DOWNLOAD and command != _ABORT_COMMAND:
        return SdoRequest.BLOCK_SEGMENT
    return _REQUESTS[command]
