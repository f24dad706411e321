"""Many worlds with autoreset, in this process or shared out over worker processes."""
