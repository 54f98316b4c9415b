"""`machine` for the benchmarks."""

from physics3d.machine import machine as machine
