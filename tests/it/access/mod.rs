//! Who may do what: certificates, keys, tenants, and addresses to listen on.

mod outside;
mod scopes;
mod tenants;
mod tls;
mod unauthenticated;
