"""What the package knows of driving besides its rules; settings are the defaults, made for it."""

from mirror_ppl.domains.record import Record

RECORD = Record(
    slow=(),
    people="mirror_ppl.domains.driving.participants:DRIVERS",
    pictures="mirror_ppl.domains.driving.pictures:PICTURES",
    rounds="mirror_ppl.domains.driving.pictures:ROUNDS",
)
