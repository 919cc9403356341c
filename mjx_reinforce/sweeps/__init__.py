"""Sweeps: many configurations, many seeds of each, as one axis of the programs of a run.

A run of a sweep is the run of ``train`` with its settings and seed, up to rounding. So are runs in
other chunks, slots or lanes, or on more devices: programs of another width or for several devices
may round the last bit of a float32 in another way, and training amplifies that. On a CPU, 24 runs
of InvertedPendulum were trained in one slot (``training.slots``), in two and in three, and on 2 and
8 devices: their parameters differed by 3e-8 of the largest after one update, 2e-7 after five, 1e-5
after ten and 1e-2 after twenty. ``exact`` moves every
run by itself, by one program, so that nothing but the run itself decides any bit.
"""
