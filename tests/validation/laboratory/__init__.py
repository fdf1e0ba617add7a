"""Another laboratory's simulator of orbital images of the Moon, with which `lunargr diagnose` is judged.

It was written from the literature by an author who did not know lunargr's code: of the program it knows only what
`lunargr diagnose --list` says about each effect, and the format of pairs.h5. Nothing here imports the program, and nothing in
the program is tuned on a seed whose results are reported. `tests/validation/laboratory_campaign.py` runs it.

    from laboratory.cases import deal, make_case
    truth = make_case(0, deal(seed, 44)[0], seed, Path("case_000.h5"))
"""
