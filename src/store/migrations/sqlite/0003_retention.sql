-- What retention looks for: jobs that have ended, the oldest end first.
CREATE INDEX jobs_end ON jobs (end_time) WHERE end_time IS NOT NULL;
-- Covers what admission sums of one tenant.
CREATE INDEX jobs_tenant_load ON jobs (tenant, input_bytes, observation_count) WHERE state = 'QUEUED';
