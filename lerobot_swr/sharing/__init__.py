"""What is shared with others: cards of policies and datasets, and the folders that carry them.

* `markdown`: tables and text that no data can break.
* `measures`: the figures of result files, with their intervals.
* `pictures`: styles and demonstrations at a glance.
* `policy_card`: what a checkpoint can do; every saved style policy has one.
* `dataset_card`: what a dataset's demonstrations show.
* `folders`: complete folders, ready to be uploaded, without code in them.
"""
