"""What every part of the package uses: threads, memory, intervals."""
