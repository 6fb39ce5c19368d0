"""The answer of `compare`: how far apart are two plans, settings, teams or maps?"""
