"""`vipectl`: annotate one video, run the service, talk to it, and use its output."""
