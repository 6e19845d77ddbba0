//! Who may do what: certificates, keys, tenants, and addresses to listen on.

mod outside;
mod strangers;
mod tenants;
mod tls;
