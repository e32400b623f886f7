"""Flight that must not touch anything: who decides what the vehicle is told, and what could have been done."""
