"""Views over ZeroMQ: poses and Suns in, arrays out. docs/serve.md is the protocol."""

from __future__ import annotations

import json
import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from schemas.checks import parse_json
from schemas.errors import ConfigError, InputError, LunargrError
from schemas.files.user_files import check_keys
from stages.render.renderer import Frame, Renderer

ARRAYS = tuple(f.name for f in fields(Frame) if f.name != "camera")
KEYS = ("camera", "sun", "arrays", "seed")
LARGEST_REQUEST = 1 << 20  # bytes
LARGEST_VIEW = 1 << 24  # pixels


def serve(renderer: Renderer, address: str, port: int, ready: Callable[[str], None]) -> None:
    """Answer requests until interrupted. Raises ConfigError where the address cannot be had.

    port : 0 for any that is free; ready : called once, with the address
    """
    try:
        import zmq
    except ModuleNotFoundError:
        raise ConfigError("serve: expected the package 'pyzmq', found none; pip install 'lunargr[serve]'.") from None
    with zmq.Context() as context, context.socket(zmq.REP) as socket:
        socket.linger = 0  # a client that has gone does not keep the program
        socket.maxmsgsize = LARGEST_REQUEST
        try:
            socket.bind(f"tcp://{address}:{port}")
        except zmq.ZMQError as error:
            raise ConfigError(
                f"serve: {address}:{port} cannot be had ({error.strerror}); choose another `port`."
            ) from None
        ready(socket.getsockopt_string(zmq.LAST_ENDPOINT))
        while True:
            socket.send_multipart(answer(renderer, socket.recv_multipart()))


def answer(renderer: Renderer, message: list[bytes]) -> list[bytes]:
    """The reply to a request: a JSON header, then the bytes of each array that it lists; or a header with an ``error`` alone."""
    try:
        header, arrays = _view(renderer, message)
    except LunargrError as error:
        return [_json({"error": str(error)})]
    except Exception as error:  # a bug, or no memory: the next client need not suffer from it
        traceback.print_exc(file=sys.stderr)
        return [_json({"error": f"internal error: {type(error).__name__}: {' '.join(str(error).split())}"})]
    return [_json(header), *arrays]


def _view(renderer: Renderer, message: list[bytes]) -> tuple[dict[str, Any], list[bytes]]:
    """Header and arrays of one view. Raises LunargrError."""
    if len(message) != 1:
        raise InputError(f"request: expected one frame of JSON, found {len(message)} frames.")
    try:
        text = message[0].decode()
    except UnicodeDecodeError:
        raise InputError("request: expected JSON in UTF-8, found other bytes.") from None
    request = parse_json(text, "request", InputError, "mend it")
    if not isinstance(request, Mapping):
        raise InputError(f"request: expected a JSON object, found a {type(request).__name__}.")
    check_keys(request, KEYS, "request")
    for key in ("camera", "sun"):
        if not isinstance(request.get(key, {}), Mapping) or (key == "camera" and key not in request):
            raise InputError(f"request: '{key}': expected a JSON object, found {request.get(key)!r:.60}.")
    seed, wanted = request.get("seed", 0), request.get("arrays", ["image"])
    if not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= seed < 2**63:
        raise InputError(f"request: 'seed': expected a whole number of at least 0, found {seed!r:.60}.")
    known = [name for name in ARRAYS if name != "dn" or renderer.sensor is not None]
    if not isinstance(wanted, list) or not all(name in known for name in wanted):
        raise InputError(f"request: 'arrays': expected a list of {', '.join(known)}, found {wanted!r:.60}.")
    camera = renderer.camera(request["camera"])
    if camera.lines * camera.samples > LARGEST_VIEW:
        raise InputError(
            f"request: expected a view of at most {LARGEST_VIEW:,} pixels, found {camera.samples} x {camera.lines}."
        )
    frame = renderer.view(camera, request.get("sun"), seed)
    arrays = {name: np.ascontiguousarray(getattr(frame, name)) for name in wanted}
    listed = [{"name": n, "dtype": a.dtype.str, "shape": list(a.shape)} for n, a in arrays.items()]
    return {"arrays": listed}, [a.tobytes() for a in arrays.values()]


def _json(header: Mapping[str, Any]) -> bytes:
    return json.dumps(header).encode()
