"""Programs in processes of their own, with as many CPU devices as a test wants: a process cannot change its own."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import derivatives

ROOT = Path(__file__).parent.parent.parent
QUICKLY = " ".join(f"--{name}={str(value).lower()}" for name, value in derivatives.QUICKLY.items())


def begun(program: str, devices: int, *arguments: str, quickly: bool = True) -> subprocess.Popen:
    """A process that runs `program`, text of Python, with arguments."""
    kept = {name: value for name, value in os.environ.items() if name not in ("XLA_FLAGS", "JAX_NUM_CPU_DEVICES")}
    flags = f"--xla_force_host_platform_device_count={devices}" + (f" {QUICKLY}" if quickly else "")
    environment = kept | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", program, *arguments]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def ended(process: subprocess.Popen, seconds: float = 600) -> dict:
    """What a process has printed last, as JSON; one that does not end is stopped."""
    try:
        out, err = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    assert process.returncode == 0, err[-4000:]
    return json.loads(out.strip().splitlines()[-1])


def ran(program: str, *arguments: str, devices: int = 4, quickly: bool = True) -> dict:
    """What a program prints last, as JSON."""
    return ended(begun(program, devices, *arguments, quickly=quickly))


def free_port() -> int:
    """One on loopback that nothing listens on."""
    with socket.socket() as listening:
        listening.bind(("localhost", 0))
        return int(listening.getsockname()[1])
