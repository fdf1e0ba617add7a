"""What every part of the package uses: threads, memory, caches, intervals, the page of reports."""
