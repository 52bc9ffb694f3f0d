"""The reports of a campaign: the same records, told to four readers.

- a person at the terminal (`table`): how it goes while it runs, and what it came to;
- a CI (`junit`): a test case per stratum and per gate, with the command that repeats the worst experiment;
- a person who wants to understand (`html`): one file that needs neither network nor script;
- another program (`export`): a row per experiment, as CSV or Parquet.

All of them are made from the ledger and its summary, and from nothing else, so they can be made again at any
time. What is judged is judged in `campaign.summary`; here it is only shown. The HTML report alone runs
something: the few runs that it draws are simulated once more, since a ledger keeps no messages.
"""
