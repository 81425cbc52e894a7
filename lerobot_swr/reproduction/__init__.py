"""The paper's experiments as independent cells: defined, computed, stored, summarised, reported.

settings → suites → cells → execution (training, measurement, similarity) → summary → tables, figures → report
"""
