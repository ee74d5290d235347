"""The record of driving; settings other than the planner's margin are the package's defaults."""

from mirror_ppl.domains.record import Record

RECORD = Record(
    planning={"min_standard_errors": 1.0},
    slow=(),
    people="mirror_ppl.domains.driving.participants:DRIVERS",
    pictures="mirror_ppl.domains.driving.pictures:PICTURES",
    rounds="mirror_ppl.domains.driving.pictures:ROUNDS",
)
