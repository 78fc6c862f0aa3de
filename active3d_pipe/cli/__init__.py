"""The command line. The only room that prints or exits; heavy imports stay inside the commands."""
