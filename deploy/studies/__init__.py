"""Long-running work on top of the verbs: studies and the training of networks. Only its commands
import it.

- `evaluation`, `detection`: the accuracy of restorations, and of a detector on them;
- `tradeoff`: accuracy and time of networks; `stress`: hard cases and bit flips;
- `characterize`: a sensor from its images; `demo`: a restored example;
- `recipes`: runs the recipes of the shipped networks.
"""
