"""When something is to run again: cron times in a time zone, and what becomes of each. Pure; time is an argument."""

from pipeline.schedule.cron import Cron
from pipeline.schedule.decisions import Decision, Missed, Overlap, decide
from pipeline.schedule.slots import PassedSlots, passed_slots
from pipeline.schedule.time_zones import time_zone

__all__ = ["Cron", "Decision", "Missed", "Overlap", "PassedSlots", "decide", "passed_slots", "time_zone"]
