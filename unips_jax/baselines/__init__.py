"""The methods UniPS is compared with, behind one signature."""
