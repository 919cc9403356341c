"""Sweeps: many configurations, many seeds of each, as one axis of the programs of a run.

A run of a sweep is the run of ``train`` with its settings and seed, up to rounding. So are runs in
other chunks, slots or lanes, or on more devices: programs of another width or for several devices
may round the last bit of a float32 in another way, and training amplifies that. On a CPU, 128 runs
of InvertedPendulum had the same returns to the last bit over 95 updates, all in one slot or packed
into slots of 8 and of 16 (``sweeps.packing``). Of 24 runs, on 2 and 8 devices the parameters were
5e-8 of the largest away after one update, 8e-6 after two, and after five updates some had gone
their own way (``experiments/sweep_rounding.py``). ``exact`` moves every run by itself, by one
program, so that nothing but the run itself decides any bit.
"""
