"""The reports of a campaign, and the drawings of a run, for people and for other programs.

- `progress`: how far any long command is; `terminal`: that of a campaign, and its summary;
- `junit`: for a CI, a test case per stratum and per gate, with the command that repeats the worst
  experiment;
- `html`: one file for a person, which needs neither network nor script; `worst` chooses the runs that it
  shows;
- `export`: a row per experiment, as CSV or Parquet;
- `sequence`: a simulated run as a listing, in Mermaid, and as a space-time diagram;
- `plots`: SVG, by matplotlib.

The reports of a campaign are made from its ledger and its summary alone, so they can be made again at any
time. `campaign.summary` judges; this package only shows. The HTML report alone runs something: it simulates
the few runs that it draws once more, because a ledger keeps no messages.
"""
