"""The record of driving; its settings are the package's defaults."""

from mirror_ppl.domains.record import Record

RECORD = Record(
    slow=(),
    people="mirror_ppl.domains.driving.participants:DRIVERS",
    pictures="mirror_ppl.domains.driving.pictures:PICTURES",
    rounds="mirror_ppl.domains.driving.pictures:ROUNDS",
)
