"""What a result was made with: hardware, versions, hashes, training runs."""
