# SPDX-License-Identifier: Apache-2.0
"""Measures GARPS against the truth and against other people's methods; never installed.

A wing imports only from wings above it in this list:

    rooms/     generated rooms with exact truth
    machine/   facts of the machine, the cost of a call, jobs on several processes
    training/  pictures of rooms that demo_net learns from
    pairs/     two views with the true pose; pairs/readers/ holds one file per data set
    peers/     other people's methods, registered in peers/methods.py
    rows/      one method on one pair: a row of errors
    scoring/   rows to statistics
    report/    statistics to tables, plots and checks against bars
    speed/, networks/, live/, demo/    commands of several files: `python -m bench.speed`

The modules beside the wings are commands too: run, tune, sample, repeat, two_view, train_depth, learned_photos,
demo_basin. To add a data set, write one file in pairs/readers/ and name its reader in pairs/readers/__init__.py.
To add a peer, write its function in peers/ and name it in peers/methods.py.
"""
