"""What studies of several runs share: training them in turn or on several machines, stored results,
speeds, tables."""
