"""What commands run beside the flow: stages that no pipeline names, in the command's own process, without the cache."""
