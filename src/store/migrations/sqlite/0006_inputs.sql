-- The order of listings of uploaded inputs; those of jobs alone have no name and are in no listing.
CREATE INDEX inputs_listing ON inputs (tenant, create_time, input) WHERE input IS NOT NULL;
