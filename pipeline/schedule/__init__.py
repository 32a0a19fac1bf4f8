"""The scheduler of batches and of the service: cron times, decisions, state, history. Pure; time is an argument."""

from pipeline.schedule.cron import Cron
from pipeline.schedule.rules import Missed, Overlap, Rules
from pipeline.schedule.slots import PassedSlots, passed_slots
from pipeline.schedule.state import (
    PUT_BACK,
    Entry,
    Look,
    Outcome,
    ScheduleBook,
    ScheduleState,
    decided_by,
    enter,
    look,
    miss_passed,
    miss_waiting,
    utc,
)
from pipeline.schedule.time_zones import time_zone

__all__ = [
    "PUT_BACK",
    "Cron",
    "Entry",
    "Look",
    "Missed",
    "Outcome",
    "Overlap",
    "PassedSlots",
    "Rules",
    "ScheduleBook",
    "ScheduleState",
    "decided_by",
    "enter",
    "look",
    "miss_passed",
    "miss_waiting",
    "passed_slots",
    "time_zone",
    "utc",
]
