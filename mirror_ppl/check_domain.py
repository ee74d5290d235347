"""Entry point of `mirror_ppl.check_domain`, see :mod:`mirror_ppl.commands.check_domain`."""

from mirror_ppl.commands import call

if __name__ == "__main__":
    call("check_domain")
