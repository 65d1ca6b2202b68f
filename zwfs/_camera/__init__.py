"""One model of a camera behind two masks, its calibration from known commands, and the phases that it measures."""
