"""Looking at data without changing it: what is there (`info`), how much of each class (`stats`), is it sound (`validate`)."""
