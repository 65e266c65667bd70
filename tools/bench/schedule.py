"""What limits many subjects on many cores: a simulation of the workflow's schedule from measured stages.

A stage of one thread takes its measured wall time; of more, its processor time shrinks by Amdahl's law with its serial
share. Stages of a subject follow each other, and a stage starts where cores and memory are free, subjects in their
order, as the workflow's scheduler does in effect. What is not simulated: memory bandwidth and disk that jobs share, so
that the result is a bound from above of the throughput.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class MeasuredStage:
    """cpu_s: processor seconds; serial: their share, 0 to 1, that one thread has to do alone; mem_mb: what it books."""

    name: str
    cpu_s: float
    serial: float
    mem_mb: float

    def seconds(self, threads: int) -> float:
        """Wall seconds on so many threads.."""
        return self.cpu_s * (self.serial + (1.0 - self.serial) / threads)


def serial_share(wall_s: float, cpu_s: float, threads: int) -> float:
    """The serial share for which cpu_s of work take wall_s on so many threads (> 1); within 0 to 1."""
    ideal = cpu_s / threads
    return min(1.0, max(0.0, (wall_s - ideal) / (cpu_s - ideal)))


@dataclass(frozen=True)
class SimulatedSchedule:
    """seconds: until all are done; busy: share of the cores at work; peak_mb: most that was booked at once; limits:
    {what: seconds that no schedule with that limit alone can beat}."""

    seconds: float
    busy: float
    peak_mb: float
    limits: Mapping[str, float]

    @property
    def limited_by(self) -> str:
        """The limit that comes nearest to the seconds."""
        return max(self.limits, key=self.limits.get)


def simulate(
    stages: Sequence[MeasuredStage], subjects: int, cores: int, memory_mb: float, start_s: float
) -> SimulatedSchedule:
    """So many subjects of these stages; each job books its share of the cores, as `limn run` gives it. start_s: of the
    workflow, once, and before each subject's first stage nothing more."""
    threads = max(1, cores // min(cores, subjects))
    free_cores, free_mb, now, peak, used = cores, memory_mb, start_s, 0.0, 0.0
    waiting = [(subject, 0) for subject in range(subjects)]
    running: list[tuple[float, int, int]] = []
    while waiting or running:
        for job in sorted(waiting, key=lambda job: (-job[1], job[0])):
            stage = stages[job[1]]
            booked = min(stage.mem_mb, memory_mb)
            if free_cores >= threads and free_mb >= booked:
                waiting.remove(job)
                free_cores, free_mb = free_cores - threads, free_mb - booked
                used += stage.cpu_s
                heapq.heappush(running, (now + stage.seconds(threads), *job))
        peak = max(peak, memory_mb - free_mb)
        now, subject, index = heapq.heappop(running)
        free_cores, free_mb = free_cores + threads, free_mb + min(stages[index].mem_mb, memory_mb)
        if index + 1 < len(stages):
            waiting.append((subject, index + 1))
    chain = sum(stage.seconds(threads) for stage in stages)
    rounds = -(-subjects // max(1, cores // threads))
    booked = sum(min(stage.mem_mb, memory_mb) * stage.seconds(threads) for stage in stages)
    limits = {
        "processor time": start_s + subjects * sum(stage.cpu_s for stage in stages) / cores,
        "serial shares": start_s + subjects * chain * threads / cores,
        "memory": start_s + subjects * booked / memory_mb,
        "longest chain": start_s + rounds * chain,
    }
    return SimulatedSchedule(now, used / (cores * now), peak, limits)
