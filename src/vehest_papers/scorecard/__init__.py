"""The scorecard: a front page, a page a paper and a CSV file with every claim and value of a table
of four papers, published and ours (`make scorecard`).

Made of claims.yaml, results/STUDY/tables/blocks.csv and training.csv alone: no model and no
recording is needed. ``judged`` reads and judges, ``front_page``, ``paper_pages`` and ``csv_files``
write, ``files`` is the command.
"""
