"""How long the parts of a real run take, as measured: the least and the most.

The simulator draws its delays from here (`runtime.sim`), and the bounds of fault handling are made of the
greatest of them (`judge.handling_bound`).
"""

from typing import Final

SIGNAL_NS: Final = (5_000, 60_000)
LIFELINE_NS: Final = (100_000, 300_000)
PIDFD_NS: Final = (500_000, 800_000)
LINE_NS: Final = (15_000, 60_000)  # an order, or an answer
FIRST_NS: Final = (100_000, 250_000)  # the first order of its kind runs code that no cache holds
ROUSED_NS: Final = (200_000, 450_000)  # the executive sleeps while requests flow
SLEEPS_AFTER_NS: Final = 5_000_000
BIRTH_NS: Final = (500_000, 3_000_000)
IDLE_BEFORE_COLD_NS: Final = 20_000_000  # a reader that was idle for so long has lost its caches
COLD_PENALTY_NS: Final = (10_000, 50_000)  # added to its next read

# The delay of one hop between two processes, as measured: the `quantiles_ns` of `aftbed bench hops --json`
# (`aftbed/bench/cycle.py` says what a hop is) for `pbr`, one process per brick, 30 000 samples, on a virtual
# machine of two cores under CPython 3.11, 2026-11-21. Other work ran on that machine meanwhile; of 83 runs
# this is the one with the lowest median.
#
# Limits: the last value is the longest delay of all, and is due to the machine's other work more than to a
# hop. It stands for one sample of 30 000, not for one of 128: to draw evenly between the last two values
# makes the mean 17 us, where it is less than 10 us.
# fmt: off
HOP_QUANTILES_NS: Final[tuple[int, ...]] = (  # 0/128, 1/128, ..., 128/128: eight to a row
    6_359, 7_171, 7_291, 7_421, 7_551, 7_691, 7_771, 7_831,
    7_871, 7_902, 7_932, 7_962, 7_992, 8_012, 8_042, 8_062,
    8_092, 8_112, 8_142, 8_172, 8_202, 8_232, 8_262, 8_292,
    8_313, 8_342, 8_362, 8_383, 8_403, 8_432, 8_452, 8_472,
    8_492, 8_503, 8_523, 8_552, 8_573, 8_593, 8_613, 8_633,
    8_662, 8_683, 8_703, 8_723, 8_743, 8_764, 8_783, 8_803,
    8_823, 8_843, 8_863, 8_883, 8_903, 8_923, 8_943, 8_954,
    8_974, 8_993, 9_013, 9_033, 9_053, 9_073, 9_084, 9_104,
    9_124, 9_153, 9_173, 9_194, 9_214, 9_234, 9_264, 9_284,
    9_314, 9_344, 9_364, 9_394, 9_434, 9_465, 9_505, 9_554,
    9_595, 9_644, 9_684, 9_725, 9_765, 9_804, 9_844, 9_875,
    9_915, 9_945, 9_975, 10_005, 10_035, 10_065, 10_085, 10_115,
    10_145, 10_165, 10_195, 10_225, 10_255, 10_285, 10_325, 10_365,
    10_405, 10_445, 10_486, 10_555, 10_616, 10_696, 10_796, 10_906,
    11_046, 11_206, 11_397, 11_587, 11_927, 12_438, 12_578, 12_699,
    12_919, 13_330, 13_891, 14_141, 14_452, 15_483, 20_600, 40_370,
    1_928_399,
)
# fmt: on
