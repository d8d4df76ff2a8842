"""The stages that make a judge, and what judges cost the stages that ask them."""
