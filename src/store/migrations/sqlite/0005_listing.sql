-- The order of listings. Jobs of one microsecond go by their ids, which are their tenant's own: the number of the row would
-- tell in a page token how many jobs all tenants have made.
DROP INDEX jobs_listing;
CREATE INDEX jobs_listing ON jobs (tenant, create_time, job);
