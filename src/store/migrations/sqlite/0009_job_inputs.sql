-- The id of the uploaded input that a job was created with, also once that has lost its name; none where the input came
-- inside the job.
ALTER TABLE jobs ADD COLUMN uploaded_input TEXT;
-- Of jobs that are there already, as far as their inputs still have a name.
UPDATE jobs SET uploaded_input = (SELECT input FROM inputs WHERE inputs.id = jobs.input_id)
WHERE input_id IN (SELECT id FROM inputs WHERE input IS NOT NULL);
