"""Commands in processes that start at once: forks of one that has imported what they need.

Importing takes each interpreter three seconds. The streams, the signals and the end of a fork are
those of any process; only what is about an interpreter's start needs one of its own.
"""

import gc
import io
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
from importlib import import_module

IMPORTED = (
    # xarray asks the last of these for a lock whenever it writes, where it is installed.
    *("h5netcdf", "scipy.stats", "tyro", "xarray", "distributed"),
    *(f"mirror_ppl.commands.{name}" for name in ("check_domain", "fit", "simulate", "train")),
    *("mirror_ppl.data", "mirror_ppl.domains.driving.participants", "mirror_ppl.option_help"),
    *("mirror_ppl.inference.engines", "mirror_ppl.models", "mirror_ppl.people"),
)
"""What most commands import sooner or later."""
SECONDS = 120
"""Seconds after which a command counts as hanging."""


class Forks:
    """Starts commands."""

    def __init__(self):
        self.socket, other = socket.socketpair()
        self.socket.settimeout(SECONDS)
        self.answers = self.socket.makefile("r")
        with other:
            number = other.fileno()
            words = [sys.executable, __file__, str(number)]
            # Streams that take pipes and files alike, as they do not believe that they can seek.
            pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
            # With buffers that are written at the end, as users have them.
            own = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}
            self.process = subprocess.Popen(words, pass_fds=[number], env=own, **pipes)

    def start(self, module, *args, stdout, stderr, encoding=None):
        """Start ``python -m module``, or its function after a colon, and return its number."""
        words = json.dumps([encoding, module, *map(str, args)]).encode()
        socket.send_fds(self.socket, [words], [stdout.fileno(), stderr.fileno()])
        return int(self.answers.readline())

    def status(self, process):
        """The exit status of one that was started, negative if a signal killed it."""
        self.socket.sendall(json.dumps(process).encode())
        return int(self.answers.readline())

    def run(self, module, *args, stdout=None, stderr=None, encoding=None):
        """What came of a command, as of `subprocess.run`; streams that are not given are caught."""
        with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
            streams = {"stdout": stdout or out, "stderr": stderr or err}
            status = self.status(self.start(module, *args, **streams, encoding=encoding))
            caught = [stream.seek(0) or stream.read() for stream in (out, err)]
        return subprocess.CompletedProcess([module, *args], status, *caught)

    def close(self):
        """End the process that forks."""
        self.answers.close()
        self.socket.close()
        said = self.process.communicate(timeout=SECONDS)
        assert said == (b"", b""), said


def serve(own):
    """Fork, or wait for a fork, as requested. Only forks return, with what they are to be."""
    while words := (received := socket.recv_fds(own, 2**16, 2))[0]:
        request, streams = json.loads(words), received[1]
        if isinstance(request, int):
            answer = os.waitstatus_to_exitcode(os.waitpid(request, 0)[1])
        elif not (answer := os.fork()):
            for number, stream in enumerate(streams, 1):
                os.dup2(stream, number)
                os.close(stream)
            return request
        for stream in streams:
            os.close(stream)
        own.sendall(f"{answer}\n".encode())
    raise SystemExit


def main():
    """Fork until there are no more requests; forks are commands."""
    sys.path[:0] = [os.getcwd()]  # as of `python -m`
    for module in IMPORTED:
        import_module(module)
    gc.freeze()  # forks share what is imported, and do not look through it
    with socket.socket(fileno=int(sys.argv[1])) as own:
        encoding, module, *args = serve(own)
    # Whoever runs these tests in the background may have had it ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if encoding is not None:
        for stream in (sys.stdout, sys.stderr):
            assert isinstance(stream, io.TextIOWrapper)
            stream.reconfigure(encoding=encoding)
    module, _, function = module.partition(":")
    sys.argv = [module, *args]
    if function:
        getattr(import_module(module), function)()
    else:
        runpy.run_module(module, run_name="__main__", alter_sys=True)


def dask():
    """Be a Dask scheduler, or a worker of the one at an address, while there is who forked this."""
    import asyncio

    from distributed import Scheduler, Worker

    parent, address = os.getppid(), sys.argv[1:]

    async def be():
        if address:
            being = Worker(address[0], nthreads=1, dashboard_address=":0")
        else:
            being = Scheduler(host="127.0.0.1", port=0, dashboard_address=":0")
        async with being as own:
            print(own.address, flush=True)
            while os.getppid() == parent:
                await asyncio.sleep(0.5)

    asyncio.run(be())


if __name__ == "__main__":
    main()
