"""Entry point of `python -m mirror_ppl.assist`, see :mod:`mirror_ppl.commands.assist`."""

from mirror_ppl.commands import call

if __name__ == "__main__":
    call("assist")
